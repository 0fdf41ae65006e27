# SPDX-License-Identifier: Apache-2.0
"""An operator who knows Linux, but not shmmap, learns all they need from the command line alone."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
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
from tests.support.daemon_process import Deadline
from tests.support.divided_map import DividedMap, make_map

DEADLINE_S = 60.0


def after(shmmap: Shmmap, wanted: Callable[[dict[str, int]], bool]) -> dict[str, int]:
    """Wait until the counters are as wanted; returns them."""
    waiting = Deadline()
    with StatisticsReader(shmmap.daemon.instance, shmmap.daemon.shm_dir) as reader:
        while waiting(not wanted(reader.snapshot(tables=False).counters)):
            pass
        return reader.snapshot(tables=False).counters


def until_shown(shmmap: Shmmap, count: int) -> None:
    """Wait until the table of resident cells has ``count`` rows: it lags a little behind."""
    waiting = Deadline()
    with StatisticsReader(shmmap.daemon.instance, shmmap.daemon.shm_dir) as reader:
        while waiting(len(reader.snapshot().cells) < count):
            pass


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
    until_shown(shmmap, len(divided_map.in_circle(0, 0, 25)))
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
    until_shown(shmmap, 4)
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


@pytest.mark.parametrize(("verb", "shown"), [("top", b"no client is connected"), ("tail", b"the daemon is")])
def test_a_terminal_that_is_gone_ends_what_shows_without_end(shmmap: Shmmap, verb: str, shown: bytes) -> None:
    ours, theirs = pty.openpty()
    environment = shmmap.environment | {"TERM": "xterm-256color", "COLUMNS": "100", "LINES": "40"}
    with subprocess.Popen(
        [sys.executable, "-m", "shmmap.cli", verb],
        env=environment, stdin=subprocess.DEVNULL, stdout=theirs, stderr=subprocess.PIPE,
        start_new_session=True,  # which has no terminal of its own: no SIGHUP comes
    ) as program:  # fmt: skip
        os.close(theirs)
        read_until(ours, shown)
        os.close(ours)
        assert program.wait(DEADLINE_S) == 141
        assert program.stderr is not None
        assert program.stderr.read() == b""
