# SPDX-License-Identifier: Apache-2.0
"""Fetching ahead as clients and operators see it: through a time without the map's files, and after it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from shmmap import Circle, MapWindow, connect
from shmmap.events import EventStream
from shmmap.protocol import events as e
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.cpp_client import CppEventStream
from tests.support.daemon_process import DaemonProcess, Deadline, first_answer, until
from tests.support.divided_map import DividedMap, make_map

pytestmark = pytest.mark.usefixtures("layer_kernels")

TIMEOUT_S = 60.0
EAST = [(-160.0, 0.0), (160.0, 0.0)]
Listen = Callable[[DaemonProcess], list[Any]]


@pytest.fixture
def street(tmp_path: Path) -> DividedMap:
    """Return a map of two cells beside one another every 20 m, from -160 to 160 m along x."""
    return make_map(tmp_path / "street", columns=16, rows=2, points=60)


@pytest.fixture
def listen(
    daemon: DaemonFactory,  # it judges after these are closed
    cpp_program: Path,
) -> Iterator[Listen]:
    """Open event streams in Python and in C++, closed before the daemon is judged."""
    opened: list[Any] = []

    def both(to: DaemonProcess) -> list[Any]:
        opened.append(EventStream(to.endpoint, since=60, timeout=TIMEOUT_S))
        opened.append(CppEventStream(cpp_program, to.endpoint, since=60))
        return opened

    yield both
    for stream in opened:
        stream.close()


def next_event(stream: Any, fits: Callable[[Any], bool]) -> Any:
    """Return the first event that fits."""
    while True:
        happening = stream.next(TIMEOUT_S)
        assert happening is not None
        if fits(happening):
            return happening


def until_ahead(shmmap: Shmmap, fits: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """Read the counters of prefetching until they fit."""
    return first_answer(lambda: shmmap.json("status")["ahead"], fits)


def listed(shmmap: Shmmap, state: str) -> set[str]:
    return {Path(row["id"]).name for row in shmmap.json("ls", "--state", state)["cells"]}


def prefetching(shmmap: Shmmap) -> dict[str, Any]:
    """Return what doctor finds of prefetching."""
    (finding,) = [f for f in shmmap.json("doctor")["findings"] if f["name"] == "prefetching"]
    found: dict[str, Any] = finding
    return found


def test_a_drive_through_a_time_without_the_files(
    daemon: DaemonFactory, street: DividedMap, listen: Listen, tmp_path: Path
) -> None:
    """The client says that it drives at 5 m/s along its route, and moves when the test says so."""
    one = daemon(street.root, "--workers", "3", environment={"SHMMAP_TEST_WORKER": "offline:"})
    shmmap, streams = Shmmap(one, tmp_path), listen(one)
    assert shmmap.json("status")["ahead"]["prefetch_started"] == 0, "no client moves"
    marks = [Path(street.id(name) + ".offline") for name in street.corners]
    with MapWindow(one.endpoint, 6.0, name="driver") as window:
        assert window.move_to(-150, 0, vx=5.0, route=EAST, wait=TIMEOUT_S).complete
        fetched = {f"{x}_{y}.pcd" for x in (-140, -120, -100) for y in (-20, 0)}
        until(lambda: fetched <= listed(shmmap, "ahead"))  # for the ten seconds of --outage-tolerance
        ahead_now = until_ahead(shmmap, lambda ahead: ahead["prefetch_started"] >= len(fetched))
        assert ahead_now["outage_tolerance_s"] == 10.0
        assert (ahead_now["prefetch_misses"], ahead_now["prefetch_used"], ahead_now["origin_out"]) == (
            0,
            0,
            False,
        )
        finding = prefetching(shmmap)
        assert (finding["state"], finding["fact"]) == (
            "ok",
            "moving clients waited for no cell in the last 10 min",
        )
        for stream in streams:
            event = next_event(stream, lambda h: isinstance(h, e.Loaded) and h.id == "-120_0.pcd")
            assert event.ahead
        assert listed(shmmap, "resident") >= {"-160_0.pcd", "-160_-20.pcd"} | fetched
        assert "+ fetched ahead" in shmmap("map").splitlines()[-2]

        for mark in marks:
            mark.touch()
        assert window.move_to(-100, 0, vx=5.0, route=EAST, wait=TIMEOUT_S).complete
        ahead_now = until_ahead(shmmap, lambda ahead: bool(ahead["origin_out"]))
        assert ahead_now["prefetch_misses"] == 0, "no client has noticed"
        assert ahead_now["prefetch_used"] == 4
        shown = {row["id"]: row["ahead"] for row in shmmap.json("ls")["cells"]}
        assert not shown[street.id("-100_0.pcd")]
        assert shown[street.id("-140_0.pcd")], "it was passed by"
        finding = prefetching(shmmap)
        assert finding["state"] == "warn"
        assert finding["fact"].startswith("the map's storage is out of reach: no load has succeeded for ")
        assert "`shmmap tail` says why loads fail" in finding["advice"]
        assert "origin out of reach for" in " ".join(shmmap("status").split())
        assert "origin out of reach for" in " ".join(shmmap("top").split())

        x, waiting = -60, Deadline()
        while waiting(
            not shmmap.json("status")["counters"]["prefetch_misses"]
        ):  # beyond what was fetched in time
            x = min(x + 20, 100)
            window.move_to(x, 0, vx=5.0, route=EAST)
        for stream in streams:
            late = next_event(stream, lambda h: isinstance(h, e.PrefetchMiss))
            assert (late.client, late.layer) == ("driver", "points")
            assert 1 <= late.cells <= len(street.corners)
            assert late.id in set(street.corners) - fetched
        assert any(" miss " in line and "driver" in line for line in shmmap("tail").splitlines())
        assert shmmap.json("status")["counters"]["prefetch_misses"] >= late.cells

        for mark in marks:
            mark.unlink()
        assert window.wait_until_current(TIMEOUT_S)
        ahead_now = until_ahead(shmmap, lambda ahead: not ahead["origin_out"])
        assert ahead_now["last_outage_s"] > 0.0
        assert ahead_now["over_fetch"] > 1.0
        top = shmmap.json("top")
        assert top["ahead"].keys() == ahead_now.keys()
        assert top["latency_s"]["load_points"]["count"] == top["latency_s"]["load"]["count"] > 8
        metrics = shmmap("metrics")
        shown_as = {
            text.split("{")[0]: float(text.split()[-1]) for text in metrics.splitlines() if "{" in text
        }
        assert shown_as["shmmap_origin_outages_total"] >= 1.0
        assert shown_as["shmmap_load_points_seconds_count"] > 8.0
        assert shown_as["shmmap_prefetch_misses_total"] >= 1.0


def test_switched_off(daemon: DaemonFactory, street: DividedMap, tmp_path: Path) -> None:
    """What clients have to wait for is counted all the same."""
    one = daemon(street.root, "--prefetch-share", "0")
    shmmap = Shmmap(one, tmp_path)
    with MapWindow(one.endpoint, 6.0, background=False) as window:
        window.move_to(-150, 0, vx=5.0, route=EAST, wait=TIMEOUT_S)
        window.move_to(-110, 0, vx=5.0, route=EAST, wait=TIMEOUT_S)
        finding = first_answer(
            lambda: prefetching(shmmap), lambda one: one["advice"] == "raise --prefetch-share"
        )
    assert finding["fact"] == "off; moving clients waited for 2 cells in the last 10 min"
    ahead_now = shmmap.json("status")["ahead"]
    assert (ahead_now["prefetch_misses"], ahead_now["prefetch_started"]) == (2, 0)


def test_load_times_by_what_was_done(daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path) -> None:
    """A daemon that keeps nothing in memory for the next one finds computed layers on disk."""
    one = daemon(divided_map.root, "--cache-dir", str(tmp_path / "cache"))
    shmmap = Shmmap(one, tmp_path)
    names = ("load", "load_points", "load_computed", "load_cached")

    def counts(wanted: tuple[int, ...]) -> None:
        with connect(one.endpoint, timeout=TIMEOUT_S) as client:
            for layer in ("voxel(leaf=2.0)", "points"):
                client.area(Circle(0, 0, 1), layer, wait=TIMEOUT_S).raise_for_failures()
        found = first_answer(
            lambda: shmmap.json("top")["latency_s"], lambda one: one["load"]["count"] >= sum(wanted)
        )
        assert [found[name]["count"] for name in names] == [sum(wanted), *wanted]
        assert all(found[name]["p50"] > 0.0 for name in names if found[name]["count"])

    counts((4, 4, 0))
    assert all(title in shmmap("top") for title in ("  of points", "  computed"))
    assert one.stop() == 0
    one.start()
    counts((4, 0, 4))
    shown = shmmap("top")
    assert "  disk cache" in shown
    assert "  computed" not in shown
