# SPDX-License-Identifier: Apache-2.0
"""Screens on terminals of two sizes, compared with texts; ``SHMMAP_TEST_DRAW=1`` writes these texts."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from shmmap.cli.screens.history import History
from shmmap.cli.screens.map_scene import Scene, terminal_map
from shmmap.cli.screens.output import Line, painted, print_pairs, print_table
from shmmap.cli.screens.top_screen import View, screen
from shmmap.cli.verbs.live.served import _MAP_COLUMNS, _map_row
from shmmap.cli.verbs.look.map_view import _print as print_map
from shmmap.cli.verbs.look.monitors import _print_findings
from shmmap.cli.verbs.look.status import _status_lines, _verdict_lines
from shmmap.doctor.verdicts import Finding, problems
from shmmap.protocol.rows import CellRow, CellState, ClientRow, LiveMapRow
from shmmap.statistics.counters import BUCKETS, COUNTERS, HISTOGRAMS, bucket_of
from shmmap.statistics.layout import State, plan
from shmmap.statistics.reader import Snapshot
from tests.support.made_statistics import CLIENT, FULL, IDENTITY, MIB, snapshot
from tests.unit.cli.screens.conftest import Terminal

GOLDEN = Path(__file__).parent / "golden"
NOW_S = 2 * 3600 + 5.0
LONG = "perception_of_the_front_left_camera_and_the_lidar_behind_it_no_1"
LIVE = LiveMapRow(
    "lidar", "/live", 0.1, "map", 12, 1_234_567, 4 * MIB, 0, 3, 1, 0, 40, 9 * MIB, 100, 93, 16 * MIB
)
TROUBLE = {
    "refused_over_budget_1min": 12, "refused_over_budget_10min": 12, "refused_over_budget": 12,
    "map_problems": 2, "unloadable": 1, "loads_failed": 3,
}  # fmt: skip


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is two hours after the daemon's start."""
    monkeypatch.setattr("time.time", lambda: NOW_S)


def compared(name: str, text: str) -> None:
    """Compare with the golden text of this name."""
    assert len(LONG) == 64
    path = GOLDEN / f"{name}.txt"
    text = "".join(f"{line.rstrip()}\n" for line in text.splitlines())
    if os.environ.get("SHMMAP_TEST_DRAW"):
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8")


def clients(count: int) -> list[ClientRow]:
    names = ["localization", "planning", LONG, *(f"node_{number}" for number in range(3, count))]
    return [
        replace(
            CLIENT, session=number, client=name, pid=4242 + number, cells=count - number,
            bytes=(count - number) * MIB // 3, requests=7 * number,
            pose=None if number % 3 else (100.0 * number, -20.5),
        )
        for number, name in enumerate(names[:count])
    ]  # fmt: skip


def driven(count: int, **more: int) -> tuple[Snapshot, View]:
    """Return the last of forty looks at a daemon with this number of clients, and the view of all."""
    history = History()
    values = FULL | {"sessions": count, "last_reload_unix_ns": int((NOW_S - 300) * 1e9)} | more
    found = snapshot(values, [])
    for second in range(40):
        counts = values | {"bytes_resident": (20 + second) * MIB, "hits": 100 * second}
        counts["misses"] = second // 10 * 25
        durations = [0] * (len(HISTOGRAMS) * (1 + BUCKETS))
        for name, waits in (("request", 100 * second), ("wait", second // 5), ("load", second // 5)):
            at = [one.name for one in HISTOGRAMS].index(name) * (1 + BUCKETS)
            durations[at] = waits * 3_000_000 * (1 + second // 20)
            durations[at + 1 + bucket_of(3_000_000)] = waits
        beat = State(second + 1, (10 + second) * 10**9, 0, tuple(counts.values()), durations)
        found = Snapshot("healthy", IDENTITY, plan(COUNTERS, HISTOGRAMS), beat, beat_age_s=0.1)
        history.add(found)
    found.clients = clients(count)
    return found, View(history=history, keys=True)


def text(lines: list[Line]) -> str:
    return "\n".join(painted(line, style=False) for line in lines)


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
@pytest.mark.parametrize(("name", "count"), [("top", 12), ("top_live", 64), ("top_trouble", 3)])
def test_top(name: str, count: int, width: int, height: int) -> None:
    found, view = driven(count, **(TROUBLE if name == "top_trouble" else {}))
    found.live = [LIVE] if name == "top_live" else []
    lines = screen(found, IDENTITY, width=width, height=height, view=view)
    assert len(lines) == height
    assert max(len(line) for line in text(lines).splitlines()) <= width
    compared(f"{name}_{width}x{height}", text(lines))


def test_top_in_a_pipe_has_all_clients_and_all_figures() -> None:
    found, _ = driven(64)
    shown = text(screen(found, IDENTITY, width=100))
    assert shown.count("node_") == 61
    for label in ("requests", "load waits", "load time", "queue", "segments", "loop"):
        assert f"\n{label} " in shown


@pytest.mark.parametrize("width", [20, 40, 60, 79])
@pytest.mark.parametrize("height", [1, 2, 5, 8, 10, 15, 19, 20, 30])
@pytest.mark.parametrize("count", [0, 1, 64])
def test_top_on_any_terminal(width: int, height: int, count: int) -> None:
    """What is too long is the table's rows, which are cut, and words that are wider than the terminal."""
    found, view = driven(count, **TROUBLE)
    lines = screen(found, IDENTITY, width=width, height=height, view=view)
    assert len(lines) == height
    assert max(map(len, text(lines).splitlines())) <= width
    if height > 2:
        assert "shmmap unit" in painted(lines[0], style=False)
    if height >= 20 and count == 64 and width >= 60:
        assert "more" in painted(lines[-1], style=False)


def test_keys_scroll_and_sort() -> None:
    found, view = driven(64)

    def first() -> str:
        lines = text(screen(found, IDENTITY, width=80, height=24, view=view)).splitlines()
        return lines[next(at for at, line in enumerate(lines) if line.startswith("CLIENT")) + 1].split()[0]

    assert first() == "localization"
    for key, wanted in (
        ("j", "planning"), ("down", "perception_of_the_fro…"), ("k", "planning"), ("g", "localization"),
        ("up", "localization"), ("s", "node_63"), ("s", "localization"), ("s", "localization"),
    ):  # fmt: skip
        view.press(key)
        assert first() == wanted, (key, view.order)
    view.press("s")
    assert view.order == "memory"
    view.press("G")
    last = first()
    view.press("j")
    assert first() == last, "there is nothing below"
    view.press("page up")
    assert first() != last


def test_history_covers_all_that_was_seen() -> None:
    history = History()
    for second in range(5000):
        values = FULL | {"hits": second * 2, "misses": second}
        beat = State(second + 1, second * 10**9, 0, tuple(values.values()), [])
        history.add(Snapshot("healthy", IDENTITY, plan(COUNTERS, HISTOGRAMS), beat))
    assert history.span_s == 4999
    for width in (10, 33, 300):
        samples = history.samples(width)
        assert len(samples) == width
        assert (sum(one.hits for one in samples), sum(one.misses for one in samples)) == (2 * 4999, 4999)
        assert {one.hit_ratio for one in samples} == {2 / 3}
        assert {one.wait_s for one in samples} == {None}
        assert {one.taken for one in samples} == {0.75}


def in_terminal(monkeypatch: pytest.MonkeyPatch, width: int, height: int, show: Callable[[], None]) -> str:
    """Return what was printed on a terminal of this size."""
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("LINES", str(height))
    terminal = Terminal()
    monkeypatch.setattr("sys.stdout", terminal)
    show()
    return terminal.getvalue()


def plain(monkeypatch: pytest.MonkeyPatch, width: int, height: int, show: Callable[[], None]) -> str:
    """Return what was printed without colours; those that it has with them are checked."""
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert "\x1b[" in in_terminal(monkeypatch, width, height, show)
    monkeypatch.setenv("NO_COLOR", "1")
    shown = in_terminal(monkeypatch, width, height, show)
    assert "\x1b" not in shown
    return shown


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
def test_status(monkeypatch: pytest.MonkeyPatch, width: int, height: int) -> None:
    found, _ = driven(12, **TROUBLE)
    found.live = [LIVE]

    def show() -> None:
        print_pairs([*_verdict_lines(problems(found)), *_status_lines(found, IDENTITY)])

    compared(f"status_{width}x{height}", plain(monkeypatch, width, height, show))


def test_a_daemon_of_live_maps_alone_says_so() -> None:
    found, _ = driven(1)
    identity = dataclasses.replace(IDENTITY, map_path="")
    words = "none: this daemon serves live maps alone"
    assert ("map", words) in _status_lines(found, identity)
    assert f"\nmap         {words}\n" in text(screen(found, identity, width=80))
    assert "0 cells" not in text(screen(found, identity, width=80, height=24))


@pytest.mark.parametrize(
    ("state", "fact"),
    [("stopped", "PAUSED, no heartbeat for 100.0 ms"), ("hung", "HUNG, no heartbeat for 100.0 ms"),
     ("dead", "DEAD: it crashed or was killed"), ("starting", "starting: it does not listen yet")],
)  # fmt: skip
def test_the_verdict_has_the_worst_first(state: str, fact: str) -> None:
    counters = FULL | TROUBLE | {"defects": 1, "origin_out": 1, "last_outage_ns": 3 * 10**9}
    known = problems(snapshot(counters, [], state=state))
    states = [one.state for one in known]
    assert states == sorted(states, key=["fail", "warn"].index)
    facts = [one.fact for one in known]
    assert facts[0 if state != "starting" else states.index("warn")] == fact
    assert len(facts) == len(set(facts)) == 6
    assert all(one.advice for one in known)
    assert problems(snapshot(FULL, [])) == []


GONE = "http://10.0.0.7/maps cannot be reached: no route to host"
FINDINGS = [
    Finding("daemon", "ok", "instance default, pid 7, is healthy"),
    Finding("map", "fail", GONE, "see to its network"),
    Finding("link", "fail", GONE, "see to its network"),
    Finding("clock", "ok", "no published map", skipped=True),
    Finding("cells", "warn", "1 cell cannot be loaded: 0_0.pcd (points): truncated", "`shmmap inspect` it"),
    Finding("huge pages", "ok", "off for /dev/shm", "`sudo shmmap unit install --huge-pages`"),
    Finding("versions", "fail", GONE, "see to its network"),
    *(Finding(name, "ok", "in order") for name in ("socket", "group", "cache size", "prefetching", "logout")),
]


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
def test_doctor(monkeypatch: pytest.MonkeyPatch, width: int, height: int) -> None:
    """Worst first, equal causes once, and what is in order as one line; with ``--all`` all of it."""
    folded = plain(monkeypatch, width, height, lambda: _print_findings(FINDINGS, everything=False))
    compared(f"doctor_{width}x{height}", folded)
    assert folded.count(GONE[:20]) == 1
    whole = plain(monkeypatch, width, height, lambda: _print_findings(FINDINGS, everything=True))
    assert "in order" not in folded
    assert "socket, group, cache size, prefetching, logout" in whole
    assert "--all" not in whole


def cell(name: str, x: float, y: float, state: CellState) -> CellRow:
    return CellRow(name, "points", 1, "0" * 16, state, 4096, 10, (x, y, x + 20, y + 20), 3, 5, 7)


SCENE = Scene(
    bounds=(-20.0, 0.0, 100.0, 60.0),
    disk=[
        (f"{x}_{y}.pcd", (x, y, x + 20.0, y + 20.0))
        for x in range(-20, 100, 20)
        for y in range(0, 60, 20)
    ],
    rows=[cell("0_0.pcd", 0, 0, "resident"), cell("80_40.pcd", 80, 40, "zombie"),
          cell("20_20.pcd", 20, 20, "resident"), cell("20_0.pcd", 20, 0, "stale")],
    clients=[replace(CLIENT, pose=(30.0, 25.0), window=None),
             replace(CLIENT, client=LONG, pose=(55.0, 45.0), window=None)],
    now_ns=10 * 10**9,
    title="a map",
    note="a note",
)  # fmt: skip


@pytest.mark.parametrize(("width", "height"), [(40, 24), (60, 24), (80, 24), (120, 40)])
def test_map(monkeypatch: pytest.MonkeyPatch, width: int, height: int) -> None:
    """Axes in metres, a bar, names of clients and, where they have room, of cells."""
    shown = plain(monkeypatch, width, height, lambda: print_map(SCENE))
    assert len(shown.splitlines()) <= height
    assert max(map(len, shown.splitlines())) <= width
    assert "localization" in shown
    compared(f"map_{width}x{height}", shown)


@pytest.mark.parametrize("width", [40, 60, 80])
def test_a_table_names_the_columns_that_it_hides(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    """In lines of its own, none wider than the terminal."""
    rows = [_map_row(LIVE), _map_row(replace(LIVE, name="roof"))]
    shown = plain(monkeypatch, width, 24, lambda: print_table(_MAP_COLUMNS, rows))
    assert max(map(len, shown.splitlines())) <= width
    compared(f"live_ls_{width}x24", shown)


@pytest.mark.parametrize("size", [(1, 1), (10, 3), (29, 9), (30, 4), (31, 2), (200, 100)])
def test_a_map_on_any_terminal(size: tuple[int, int]) -> None:
    for scene in (SCENE, Scene((0.0, 0.0, 0.0, 0.0), [], [], [], 0, "", "")):
        lines = text(terminal_map(scene, *size, solid=True)).splitlines()
        assert max(map(len, lines)) <= size[0]
        assert len(lines) <= max(size[1], 4)
