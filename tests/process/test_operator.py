# SPDX-License-Identifier: Apache-2.0
"""An operator who knows Linux, but not shmmap, learns all they need from the command line alone."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import shmmap as client_library
from shmmap.cli.entry import main
from shmmap.cli.verbs.look import map_view
from shmmap.client.map_listing import MapListing
from shmmap.statistics.reader import StatisticsReader
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import Deadline, until
from tests.support.divided_map import DividedMap, make_map

DEADLINE_S = 60.0


def after(shmmap: Shmmap, wanted: Callable[[dict[str, int]], bool]) -> dict[str, int]:
    """Wait until the counters are as wanted; returns them."""
    waiting = Deadline()
    with contextlib.closing(StatisticsReader(shmmap.daemon.instance, shmmap.daemon.shm_dir)) as reader:
        while waiting(not wanted(reader.snapshot().counters)):
            pass
        return reader.snapshot().counters


@pytest.fixture
def shmmap(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> Shmmap:
    """Return the command line of a daemon with room for everything."""
    return Shmmap(daemon(divided_map.root), tmp_path)


@pytest.fixture
def tight(daemon: DaemonFactory, tmp_path: Path) -> Shmmap:
    """Return the command line of a daemon whose budget holds a few cells of 72 kB."""
    made = make_map(tmp_path / "tight", columns=6, rows=6, points=4200)
    return Shmmap(daemon(made.root, "--budget", "1M"), tmp_path)


def test_six_questions(tight: Shmmap) -> None:
    with client_library.connect(tight.daemon.endpoint, name="localization") as client:
        held = client.around(0.0, 0.0, radius=25.0, wait=20.0)
        cells = len(held)
        assert cells
        after(tight, lambda seen: seen["segments_pinned"] == cells and seen["sessions"] == 1)

        # is it healthy?
        assert tight("health").startswith("healthy: pid ")

        # what is resident around (x, y)?
        shown = tight("map", "--circle", "0,0,60")
        picture, legend = shown.rsplit("# in memory", 1)
        assert "@" in picture
        assert picture.count("#") > picture.count("@")
        assert "client" in legend
        near = tight.json("query", "--circle", "5,5,1", "--wait", "none")
        assert [cell["box"] for cell in near["cells"]] == [[0.0, 0.0, 20.0, 20.0]]

        # which client holds memory?
        (row,) = [line for line in tight("top").splitlines() if line.startswith("localization")]
        assert str(os.getpid()) in row
        assert re.search(r"\d+(\.\d)? KiB", row)
        (holder,) = [c for c in tight.json("clients")["clients"] if c["client"] == "localization"]
        assert holder["cells"] == cells

        # why was my request partial?
        partial = tight.run("query", "--box", "-60,-60,60,60", "--wait", "20")
        assert partial.returncode == 1
        assert "over_budget" in partial.stdout
        assert "localization" in partial.stdout

        # what changed in the last minute?
        tail = tight("tail")
        assert re.search(r"^\d\d:\d\d:\d\d\.\d{3}  joined    localization, pid ", tail, re.MULTILINE)
        assert re.search(r"loaded    0_0\.pcd points ", tail)
        assert re.search(r"pressure  [\d,]+ cells? refused, .* of 1\.0 MiB used, .* in use by clients", tail)

        # is the cache too small?
        after(tight, lambda seen: seen["refused_over_budget_10min"] > 0)
        for verb in ("status", "top"):
            assert re.search(r"^cache +too small: [\d,]+ cells refused", tight(verb), re.MULTILINE | re.I)
        judged = tight.json("top")
        assert judged["cache_too_small"]
        assert "--budget" in judged["hint"]
        assert sum(judged["memory"].values()) == 1 << 20
        del held


def test_tail_in_json_and_what_it_leaves_out(shmmap: Shmmap, divided_map: DividedMap) -> None:
    with client_library.connect(shmmap.daemon.endpoint, name="driver") as client:
        client.selected([divided_map.id("0_0.pcd")], wait=20.0)
        divided_map.change("0_0.pcd", 5)
        client.reload()
    lines = [json.loads(line) for line in shmmap("tail", "--json").splitlines()]
    kinds = [line["event"] for line in lines]
    assert kinds[:5] == ["epoch", "joined", "loaded", "reload", "changed"]
    assert all(abs(line["time"] - time.time()) < 3600 for line in lines)
    assert re.fullmatch(r"[0-9a-f]{16}", lines[2]["version"])
    assert lines[4] | {"id": "0_0.pcd", "how": "changed"} == lines[4]
    assert shmmap("tail", "--since", "0") == ""
    text = shmmap("tail")
    assert text.count("joined    shmmap tail") == text.count("left      shmmap tail")  # it leaves out itself


def test_tail_follows(shmmap: Shmmap, divided_map: DividedMap) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "shmmap.cli", "tail", "--follow", "--json", "--since", "0"],
        env=shmmap.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as tail:  # fmt: skip
        try:
            assert tail.stdout is not None
            waiting = Deadline()
            seen: list[str] = []
            with client_library.connect(shmmap.daemon.endpoint, name="driver") as client:
                while waiting("loaded" not in seen):
                    # asked until it is printed: the program may not be up yet
                    client.evict([divided_map.id("0_0.pcd")])
                    client.selected([divided_map.id("0_0.pcd")], wait=20.0)
                    while select.select([tail.stdout], [], [], 0.1)[0]:
                        seen.append(json.loads(tail.stdout.readline())["event"])
        finally:
            tail.send_signal(signal.SIGINT)
            _, complaint = tail.communicate(timeout=DEADLINE_S)
        assert tail.returncode == 130, complaint


def test_a_client_cannot_write_to_an_operator_s_terminal(shmmap: Shmmap, divided_map: DividedMap) -> None:
    """Its name, and the name of a file of the map, hold codes that terminals obey."""
    hostile = "\x1b]0;owned\x07\x1b[2J\u202e"
    corner = divided_map.corners["0_0.pcd"]
    divided_map.write_cell("0_0\x1b[31m.pcd", corner, divided_map.points("0_0.pcd"))
    divided_map.remove_cell("0_0.pcd")
    metadata = divided_map.root / "pointcloud_map_metadata.yaml"
    divided_map.write_metadata()
    metadata.write_text(metadata.read_text().replace("0_0\x1b[31m.pcd", '"0_0\\e[31m.pcd"'))
    shmmap.json("reload")
    with client_library.connect(shmmap.daemon.endpoint, name=hostile) as client:
        held = client.around(5.0, 5.0, radius=1.0, wait=20.0)
        assert [Path(cell.id).name for cell in held] == ["0_0\x1b[31m.pcd"]
        after(shmmap, lambda seen: seen["sessions"] == 1 and seen["cells_resident"] == 1)
        both = ("clients", "tail", "top", "ls", "status", "pin")
        verbs = [[verb] for verb in both] + [[verb, "--json"] for verb in both]
        verbs += [["query", "--circle", "5,5,1"], ["show", held[0].id], ["map"]]
        for words in verbs:
            text = shmmap(*words)
            assert all(line.isprintable() for line in text.splitlines()), words
            if words[0] in ("clients", "tail"):
                assert "owned" in text, words
            if words[0] in ("ls", "query", "show"):
                assert "[31m.pcd" in text, words
        done = shmmap.run("show", hostile)
        assert done.returncode == 1
        assert all(line.isprintable() for line in done.stderr.splitlines())
        del held


def test_metrics_and_files(shmmap: Shmmap, divided_map: DividedMap, tmp_path: Path) -> None:
    shmmap("query", "--circle", "0,0,25")
    metrics = shmmap("metrics")
    assert f'shmmap_up{{daemon="{shmmap.daemon.instance}"}} 1' in metrics
    picture, page = tmp_path / "map.svg", tmp_path / "map.html"
    shmmap("map", "--svg", str(picture), "--html", str(page))
    tree = ElementTree.fromstring(picture.read_text())
    resident = ".//{http://www.w3.org/2000/svg}rect[@class='cell resident']/{http://www.w3.org/2000/svg}title"
    assert len(tree.findall(resident)) == len(divided_map.in_circle(0, 0, 25))
    assert "<!doctype html>" in page.read_text()
    assert "cannot write" in shmmap.run("map", "--svg", str(tmp_path / "no" / "map.svg")).stderr


def test_a_picture_of_too_many_cells(
    shmmap: Shmmap,
    divided_map: DividedMap,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Those on disk are left out, and not even asked for; the map's extent and those in memory are there."""
    shmmap("query", "--circle", "0,0,5")
    for name, value in shmmap.environment.items():
        if name.startswith("SHMMAP_"):
            monkeypatch.setenv(name, value)
    asked: list[object] = []
    real = client_library.Client.metadata

    def noted(client: client_library.Client, *args: Any, **options: Any) -> MapListing:
        asked.append(args)
        return real(client, *args, **options)

    monkeypatch.setattr(client_library.Client, "metadata", noted)
    monkeypatch.setattr(map_view, "MAX_ON_DISK", 10)
    assert main(["map"]) == 0
    assert not asked
    drawn, said = capsys.readouterr().out.split("its area")
    assert "#" in drawn
    assert "." not in drawn.replace(". on disk", "")
    flat = " ".join(said.split())
    assert "x -60 .. 60 m, y -60 .. 60 m; 4 segments" in flat
    assert f"{len(divided_map.corners)} cells in the map (too many to show those on disk)" in flat
    assert main(["map", "--circle", "0,0,45"]) == 0
    assert "more than 10 cells in the map (too many" in " ".join(capsys.readouterr().out.split())
    assert main(["map", "--circle", "50,50,5"]) == 0
    drawn, said = capsys.readouterr().out.split("its area")
    assert "." in drawn.replace(". on disk", "")
    assert "1 cell in the map" in " ".join(said.split())
    assert main(["map", "--circle", "900,900,5"]) == 1
    assert "the map spans x -60 .. 60 m, y -60 .. 60 m" in " ".join(capsys.readouterr().err.split())


def read_until(fd: int, wanted: bytes, seen: bytes = b"") -> bytes:
    """Read a terminal until it was sent something."""
    end_s = time.monotonic() + DEADLINE_S
    while wanted not in seen:
        assert select.select([fd], [], [], max(0.0, end_s - time.monotonic()))[0], seen
        try:
            seen += os.read(fd, 65536)
        except OSError:  # the other side is closed
            break
    assert wanted in seen, seen
    return seen


class TopScreen:
    """``shmmap top`` on a terminal of its own, as an operator sees it and types at it."""

    def __init__(self, shmmap: Shmmap, columns: int, lines: int, **variables: str) -> None:
        self._ours, self._theirs = pty.openpty()
        fcntl.ioctl(self._theirs, termios.TIOCSWINSZ, struct.pack("4H", lines, columns, 0, 0))
        self._before = termios.tcgetattr(self._theirs)
        environment = shmmap.environment | {"TERM": "xterm-256color"} | variables
        for name in {"NO_COLOR", "COLUMNS", "LINES"} - variables.keys():
            environment.pop(name, None)
        self.program = subprocess.Popen(
            [sys.executable, "-m", "shmmap.cli", "top", "--interval", "0.05"],
            env=environment, stdin=self._theirs, stdout=self._theirs, stderr=self._theirs,
            start_new_session=True,
        )  # fmt: skip
        self.raw = b""

    def __enter__(self) -> TopScreen:
        return self

    def __exit__(self, *error: object) -> None:
        self.program.kill()
        self.program.wait(DEADLINE_S)
        os.close(self._ours)
        os.close(self._theirs)

    def until(self, shown: Callable[[list[str]], bool]) -> list[str]:
        """Wait until a whole screen is as wanted; return its lines without colours."""
        end_s = time.monotonic() + DEADLINE_S
        lines: list[str] = []
        while not lines or not shown(lines):
            left_s = max(0.0, end_s - time.monotonic())
            assert select.select([self._ours], [], [], left_s)[0], "\n".join(lines)
            self.raw = (self.raw + os.read(self._ours, 65536))[-200_000:]
            whole = self.raw.decode("utf-8", "replace").rpartition("\x1b[J")[0].rpartition("\x1b[H")[2]
            lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", whole).split("\r\n")
        return lines

    def stops(self) -> None:
        """Wait until the program is stopped, not ended."""
        ended = os.waitid(os.P_PID, self.program.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        assert ended is not None
        assert ended.si_code == os.CLD_STOPPED, ended

    def press(self, keys: str) -> None:
        os.write(self._ours, keys.encode())

    def ended(self) -> int:
        """Wait for the end; the terminal is as it was."""
        self.raw = read_until(self._ours, b"\x1b[?1049l", self.raw)
        code = self.program.wait(DEADLINE_S)
        assert termios.tcgetattr(self._theirs) == self._before
        return code


def names_shown(lines: list[str]) -> list[str]:
    """Return the names in the table of clients."""
    at = next((at for at, line in enumerate(lines) if line.startswith("CLIENT")), len(lines))
    names = []
    for line in lines[at + 1 :]:
        if not line:
            break
        names.append(line.split()[0])
    return names


LONG = "perception_of_the_front_left_camera_and_the_lidar_behind_it_no_1"


def test_top_on_a_small_terminal(shmmap: Shmmap) -> None:
    """Twelve clients on 80x24: memory, the verdict, who holds most, how many more, and keys."""
    with contextlib.ExitStack() as stack:
        held = []
        for number in range(12):
            name = LONG if number == 1 else f"node_{number}"
            client = stack.enter_context(client_library.connect(shmmap.daemon.endpoint, name=name))
            held.append(client.around(0.0, 0.0, radius=60.0 - 5 * number, wait=20.0))
        with TopScreen(shmmap, 80, 24) as top:
            lines = top.until(lambda lines: " more  " in lines[-1] and "seen for" in lines[-1])
            assert len(lines) == 24
            assert max(map(len, lines)) <= 80
            assert "\x1b[1;32mhealthy" in top.raw.decode("utf-8", "replace")
            starts = [line.split("  ")[0].strip() for line in lines]
            for label in ("map", "verdict", "memory", "hits", "waits", "CLIENT"):
                assert label in starts, lines
            shown = names_shown(lines)
            assert shown[0] == "node_0"
            assert LONG[:12] in shown[1]
            assert 3 <= len(shown) < 12
            assert lines[-1].startswith(f"{12 - len(shown)} more  ")
            top.press("jj")
            assert names_shown(top.until(lambda lines: names_shown(lines)[:1] == ["node_2"]))
            top.press("\x1b[A")
            top.until(lambda lines: LONG[:12] in names_shown(lines)[0])
            top.press("sss")
            lines = top.until(lambda lines: "by name" in lines[-1])
            assert names_shown(lines)[:3] == ["node_0", "node_10", "node_11"]
            top.press("q")
            assert top.ended() == 0
        del held


def test_top_without_colours_and_on_a_tiny_terminal(shmmap: Shmmap) -> None:
    with TopScreen(shmmap, 30, 7, NO_COLOR="1") as top:
        lines = top.until(lambda lines: any(line.startswith("verdict") for line in lines))
        assert len(lines) == 7
        assert not re.search(rb"\x1b\[[0-9;]*m", top.raw)
        top.press("\x04")
        assert top.ended() == 0


def test_top_stops_and_goes_on(shmmap: Shmmap) -> None:
    """Ctrl-Z leaves the terminal as it was; when continued, it is taken again."""
    with TopScreen(shmmap, 80, 24) as top:
        top.until(lambda lines: "q quit" in lines[-1])
        top.program.send_signal(signal.SIGTSTP)
        top.stops()
        top.raw = read_until(top._ours, b"\x1b[?1049l", top.raw)
        assert termios.tcgetattr(top._theirs) == top._before
        top.program.send_signal(signal.SIGCONT)
        top.raw = b""
        top.until(lambda lines: "q quit" in lines[-1])
        top.press("q")
        assert top.ended() == 0


def test_top_stops_while_the_terminal_takes_nothing(shmmap: Shmmap) -> None:
    with TopScreen(shmmap, 80, 24) as top:
        top.until(lambda lines: "q quit" in lines[-1])
        until(lambda: not select.select([], [top._theirs], [], 0)[1])  # it is full
        top.program.send_signal(signal.SIGTSTP)
        top.raw = read_until(top._ours, b"\x1b[?1049l", b"")
        top.stops()
        top.program.send_signal(signal.SIGCONT)
        top.raw = b""
        top.until(lambda lines: "q quit" in lines[-1])


def test_a_dumb_terminal_gets_it_once(shmmap: Shmmap) -> None:
    ours, theirs = pty.openpty()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "shmmap.cli", "top"], env=shmmap.environment | {"TERM": "dumb"},
            stdin=theirs, stdout=theirs, timeout=DEADLINE_S, check=True,
        )  # fmt: skip
        assert done.returncode == 0
        assert b"\x1b" not in read_until(ours, b"no client is connected")
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, 0)]
)
def test_top_leaves_the_terminal_as_it_was(shmmap: Shmmap, number: signal.Signals, code: int) -> None:
    ours, theirs = pty.openpty()
    try:
        before = termios.tcgetattr(theirs)
        environment = shmmap.environment | {"TERM": "xterm-256color", "COLUMNS": "100", "LINES": "40"}
        environment.pop("NO_COLOR", None)
        with subprocess.Popen(
            [sys.executable, "-m", "shmmap.cli", "top", "--interval", "0.05"],
            env=environment, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
        ) as top:  # fmt: skip
            seen = read_until(ours, b"no client is connected")
            assert b"\x1b[?1049h" in seen  # the alternate screen
            top.send_signal(number)
            seen = read_until(ours, b"\x1b[?1049l", seen)
            seen = read_until(ours, b"\x1b[?25h", seen)  # the cursor is back
            assert top.wait(DEADLINE_S) == code
        assert termios.tcgetattr(theirs) == before
    finally:
        os.close(ours)
        os.close(theirs)


@pytest.mark.parametrize(
    ("verb", "keys", "shown"),
    [
        ("top", False, b"no client is connected"),
        ("top", True, b"q quit"),
        ("tail", False, b"the daemon is"),
    ],
)
def test_a_terminal_that_is_gone_ends_what_shows_without_end(
    shmmap: Shmmap, verb: str, *, keys: bool, shown: bytes
) -> None:
    ours, theirs = pty.openpty()
    environment = shmmap.environment | {"TERM": "xterm-256color", "COLUMNS": "100", "LINES": "40"}
    with subprocess.Popen(
        [sys.executable, "-m", "shmmap.cli", verb],
        env=environment, stdin=theirs if keys else subprocess.DEVNULL, stdout=theirs, stderr=subprocess.PIPE,
        start_new_session=True,  # which has no terminal of its own: no SIGHUP comes
    ) as program:  # fmt: skip
        os.close(theirs)
        read_until(ours, shown)
        os.close(ours)
        assert program.wait(DEADLINE_S) == 141
        assert program.stderr is not None
        assert program.stderr.read() == b""
