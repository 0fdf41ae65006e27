# SPDX-License-Identifier: Apache-2.0
"""Tools of the benchmarks of published maps: a map as ORIGIN.md describes it, and a slow link."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.raw_client import RawClient, circle
from tests.support.segment_reader import read_segment

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

from shmmap.errors import Offline
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import PROBE
from tests.support.made_map import CELL_M, SHARD_M, MadeMap, serve_made_map
from tests.support.published_maps import PublishedMapReader
from tests.support.slow_link import Plan, slow_link

AWAY = [(0.0, 1e12)]


def test_every_object_is_what_the_pages_say(tmp_path: Path) -> None:
    """Checked by the reader that is written from the pages alone: names, content digests, checksums."""
    made = MadeMap(40 * 40, 50)
    folder = tmp_path / "made"
    (folder / "blobs/sha256").mkdir(parents=True)
    (folder / "versions").mkdir()
    current = json.loads(made.read("CURRENT"))
    (folder / "CURRENT").write_bytes(made.read("CURRENT"))
    entry = {**current, "created": "2026-01-01T00:00:00Z", "before": 0, "restored": 0}
    (folder / "versions/1.json").write_text(json.dumps(entry))
    root = made.root
    paths = [
        f"blobs/sha256/{digest}" for digest in (current["root"], *map(bytes.hex, map(bytes, root.hashes)))
    ]
    for path in paths:
        (folder / path).write_bytes(made.read(path))
    for path in map("blobs/sha256/{}".format, map(bytes.hex, made.cells())):
        assert made.is_cell(path)
        (folder / path).write_bytes(made.read(path))
    read = PublishedMapReader(folder)
    assert len(read.cells) == 1600
    assert len({cell.versions["points"] for cell in read.cells.values()}) == 1600
    assert len(list((folder / "blobs/sha256").iterdir())) == 1600 + 4 + 1, "no two objects are equal"
    with pytest.raises(FileNotFoundError):
        made.read(f"blobs/sha256/{bytes(32).hex()}")


def test_a_daemon_serves_it_over_a_slow_link(
    daemon: DaemonFactory, connect: Callable[..., RawClient]
) -> None:
    with (
        serve_made_map(200 * 200, 50) as served,
        slow_link(Plan(served.port, mbit_s=200.0, delay_s=0.002, mean_s=0.01)) as link,
    ):
        one = daemon(link.endpoint, "--poll", "0")
        client = connect(one)
        reply = client.area(circle(SHARD_M, SHARD_M, 50.0), wait=60.0)
        assert not reply.pending
        assert not reply.failed
        found = {handle.id: read_segment(client.path(handle)) for handle in reply.cells}
        assert {(name.split("/")[-1].split("_")[0]) for name in found} == {"29", "30", "31", "32", "33", "34"}
        for segment in found.values():
            xyz = segment.columns["xyz"]
            assert len(xyz) >= 24
            assert ((xyz[:, :2] >= 0) & (xyz[:, :2] <= CELL_M)).all(), "in the box of the first cell"
            assert np.isfinite(xyz).all()
        assert served.cells_sent() >= len(found)
        assert link.received_bytes() > 4 * 50_000


def test_nothing_passes_while_the_link_is_out() -> None:
    with serve_made_map(100, 50) as served, slow_link(Plan(served.port)) as link:
        store = open_store(link.endpoint, timeouts=PROBE)
        first = bytes(store.get("CURRENT", 1000))
        link.go_out(AWAY)
        link.received_bytes()  # it has read what stands before that
        with pytest.raises(Offline):
            store.get("CURRENT", 1000)
        link.go_out([])
        link.received_bytes()
        assert bytes(store.get("CURRENT", 1000)) == first
