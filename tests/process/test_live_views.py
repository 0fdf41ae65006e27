# SPDX-License-Identifier: Apache-2.0
"""What operators see of live maps: numbers while the daemon answers or not, problems, and who is to blame."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import shmmap as client_library
from shmmap.client.event_stream import EventStream
from shmmap.protocol import events as e
from shmmap.protocol.rows import LiveMapRow
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.divided_map import DividedMap
from tests.support.live_drive import FILTER, drive
from tests.support.live_reference import LiveDaemon, worker_of
from tests.support.stored_chunks import change_chunk, largest


@pytest.fixture
def listen(live_daemon: LiveDaemon) -> Iterator[Callable[[DaemonProcess], EventStream]]:
    """Open event streams, closed before the daemon is judged."""
    opened: list[EventStream] = []

    def factory(to: DaemonProcess) -> EventStream:
        opened.append(EventStream(to.endpoint, since=60, timeout=30.0))
        return opened[-1]

    yield factory
    for stream in opened:
        stream.close()


def until(stream: EventStream, wanted: Callable[[Any], bool]) -> Any:
    """The first event from here on that is wanted."""
    while True:
        happening = stream.next(60.0)
        assert happening is not None
        if wanted(happening):
            return happening


def after(one: DaemonProcess, wanted: Callable[[LiveMapRow], bool]) -> LiveMapRow:
    """Wait until the live map's row is as wanted."""
    waiting = Deadline()
    with client_library.connect(one.endpoint) as client:
        while waiting(not wanted((rows := client.live_maps())[0])):
            pass
    return rows[0]


@contextlib.contextmanager
def mapped(one: DaemonProcess, scans: int) -> Iterator[None]:
    """Scans are in the map and on the disk, and the mapper is still there: its chunks stay in memory."""
    with (
        client_library.connect(one.endpoint) as client,
        client.live("lidar").mapper("front", FILTER) as mapper,
    ):
        for points, pose in drive(scans):
            mapper.add(points, pose)
        mapper.wait_applied()
        mapper.wait_durable()
        yield


def test_what_operators_see(live_daemon: LiveDaemon, tmp_path: Path) -> None:
    one = live_daemon()
    shmmap = Shmmap(one, tmp_path)
    with mapped(one, 3):
        row = after(one, lambda row: row.durable == 3 and row.chunks > 0 and not row.unsaved + row.loading)
        assert (row.name, row.scans, row.mapper_count, row.budget_bytes) == ("lidar", 3, 1, 16 << 20)
        assert [name.partition("/")[2] for name in row.mappers] == ["front"]
        (found,) = shmmap.json("status")["live"]
        assert tuple(found) == row.__struct_fields__ == tuple(shmmap.json("top")["live"][0])
        assert {name: found[name] for name in ("name", "scans", "problem")} == {
            "name": "lidar", "scans": 3, "problem": "",
        }  # fmt: skip
        said = r"^live lidar +[\d,]+ chunks, .* of 16\.0 MiB, [\d,]+ voxels known, all saved$"
        assert re.search(said, shmmap("status"), re.MULTILINE)
        assert re.search(r"^live +lidar: [\d,]+ chunks   [\d,]+ clean ", shmmap("top"), re.MULTILINE)
        metrics = shmmap("metrics")
        label = f'daemon="{one.instance}",map="lidar"'
        assert f"shmmap_live_scans_durable_total{{{label}}} 3\n" in metrics
        assert re.search(rf'^shmmap_live_chunks{{{label},state="clean"}} [1-9]', metrics, re.MULTILINE)

        picture = tmp_path / "live.svg"
        shmmap("map", "--live", "lidar", "--svg", str(picture))
        squares = ElementTree.fromstring(picture.read_text()).findall(
            ".//{http://www.w3.org/2000/svg}rect[@class='cell clean']/{http://www.w3.org/2000/svg}title"
        )
        assert any("in memory, saved" in (title.text or "") for title in squares)
        assert "# in memory, saved" in shmmap("map", "--live", "lidar")
        far = shmmap.run("map", "--live", "lidar", "--circle", "9000,9000,5")
        assert (far.returncode, "no chunk within 5 m" in far.stdout + far.stderr) == (1, True)
        assert shmmap.run("map", "--live", "radar").returncode == 2

        one.send(signal.SIGSTOP)
        os.waitid(os.P_PID, one.pid, os.WSTOPPED | os.WNOWAIT)
        assert shmmap.json("status")["live"] == []
        assert re.search(r"^live +lidar: the daemon does not answer$", shmmap("status"), re.MULTILINE)
        (silent,) = (one for one in shmmap.json("doctor", code=1)["findings"] if one["name"] == "live maps")
        assert (silent["skipped"], silent["fact"]) == (True, "lidar: the daemon does not answer")
        metrics = shmmap("metrics")
        assert f'shmmap_up{{daemon="{one.instance}"}} 0\n' in metrics
        assert "shmmap_live_restarts_total" in metrics
        assert "shmmap_live_chunks" not in metrics
        one.send(signal.SIGCONT)


def test_without_live_maps_nothing_is_said(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    shmmap = Shmmap(daemon(divided_map.root), tmp_path)
    assert shmmap.json("status")["live"] == shmmap.json("top")["live"] == []
    for verb in ("status", "top"):
        assert "live" not in shmmap(verb).split()


def test_events_report_changes_and_the_worker_s_end(
    live_daemon: LiveDaemon, listen: Callable[[DaemonProcess], EventStream], tmp_path: Path
) -> None:
    one = live_daemon()
    stream = listen(one)
    assert [type(stream.next(60.0)) for _ in range(2)] == [e.Epoch, e.LiveStarted]
    with client_library.connect(one.endpoint) as client:
        live = client.live("lidar")
        before = live.voxels("occupied").change
        with mapped(one, 1):
            changed = until(stream, lambda h: isinstance(h, e.LiveChanged))
            assert changed.map == "lidar"
            assert changed.change > before
            assert len(live.voxels("occupied", since=before))
            os.kill(worker_of(one), signal.SIGKILL)
    ended = until(stream, lambda h: isinstance(h, e.LiveEnded))
    assert ended.restarts == 1
    started = until(stream, lambda h: isinstance(h, e.LiveStarted))
    assert started.maps == 1
    assert started.chunks >= 1
    shmmap = Shmmap(one, tmp_path)
    assert "the process that keeps live maps ended 1 time" in shmmap("status")
    assert "shmmap_live_restarts_total{" + f'daemon="{one.instance}"' + "} 1" in shmmap("metrics")
    tail = shmmap("tail")
    assert re.search(r"  live      the live worker ended \(1 time by now\)", tail)


def test_a_damaged_chunk_is_reported_and_named(
    live_daemon: LiveDaemon, listen: Callable[[DaemonProcess], EventStream], tmp_path: Path
) -> None:
    one = live_daemon()
    with mapped(one, 1):
        pass
    one.stop()
    victim = largest(tmp_path / "lidar")
    change_chunk(tmp_path / "lidar", victim, lambda data: data[:-1])
    one.start()
    stream = listen(one)
    shmmap = Shmmap(one, tmp_path)
    with client_library.connect(one.endpoint) as client:
        live = client.live("lidar")
        x, y, z, *_ = victim.box(live.resolution)
        live.move_to(x + 1.0, y + 1.0, z + 1.0)
        damaged = until(stream, lambda h: isinstance(h, e.LiveDamaged))
        assert damaged.map == "lidar"
        assert victim.text in damaged.what
        found = {row["name"]: row for row in json.loads(shmmap.run("doctor", "--json").stdout)["findings"]}
        assert found["live maps"]["state"] == "warn"
        assert victim.text in found["live maps"]["fact"]
        assert found["live disk"]["state"] in ("ok", "warn")
        assert str(tmp_path / "lidar") in found["live disk"]["fact"]
        assert found["live memory"]["state"] == "ok"
