# SPDX-License-Identifier: Apache-2.0
"""A daemon that watches its map serves what is on disk without being asked to reload."""

from __future__ import annotations

import numpy as np

from shmmap import EventStream, connect
from shmmap.protocol import events as e
from tests.process.conftest import DaemonFactory
from tests.support.divided_map import DividedMap, make_map, random_points


def next_reload(stream: EventStream) -> e.Reloaded:
    while True:
        happening = stream.next(60.0)
        assert happening is not None, "no reload was told of"
        if isinstance(happening, e.Reloaded):
            return happening


def test_what_is_written_is_served(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root, "--watch")
    with connect(one.endpoint) as client, EventStream(one.endpoint, timeout=30.0) as stream:
        old = client.selected([divided_map.id("0_0.pcd")], wait=30.0)[0].version
        divided_map.change("0_0.pcd", 5)
        told = next_reload(stream)
        assert (told.changed, told.added, told.removed, told.error) == (1, 0, 0, "")
        newer = client.selected([divided_map.id("0_0.pcd")], wait=30.0)[0]
        assert newer.version != old
        assert len(newer.xyz) == 700

        corner = (60, 0)
        divided_map.write_cell("60_0.pcd", corner, random_points(np.random.default_rng(8), corner, 100))
        divided_map.remove_cell("0_-20.pcd")
        divided_map.write_metadata()
        added = removed = 0
        while (added, removed) != (1, 1):  # the machine may be so slow that it is told in parts
            told = next_reload(stream)
            added, removed = added + told.added, removed + told.removed
        assert client.selected([divided_map.id("60_0.pcd")], wait=30.0)


def test_a_map_that_is_away_for_a_while(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    """Until another one is in its place the old one is served; then that one, and its changes too."""
    one = daemon(divided_map.root, "--watch")
    with connect(one.endpoint) as client, EventStream(one.endpoint, timeout=30.0) as stream:
        aside = divided_map.root.with_name("aside")
        divided_map.root.rename(aside)
        assert "no map" in next_reload(stream).error
        assert client.selected(["0_0.pcd"], wait=None).failed == ()
        next_map = make_map(divided_map.root.with_name("next"), columns=2, rows=2, seed=5)
        next_map.root.rename(divided_map.root)
        told = next_reload(stream)
        assert (told.error, told.removed) == ("", 32)
        next_map.root = divided_map.root
        next_map.change("0_0.pcd", 7)
        assert next_reload(stream).changed == 1
        divided_map.change("0_0.pcd", 8)
        assert next_reload(stream).changed == 1


def test_without_the_setting_nothing_is_watched(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with connect(one.endpoint) as client, EventStream(one.endpoint, timeout=30.0) as stream:
        divided_map.change("0_0.pcd", 5)
        client.reload()
        assert next_reload(stream).changed == 1
        assert client.stats().counters["reloads"] == 1
