# SPDX-License-Identifier: Apache-2.0
"""A daemon that watches its map serves what is on disk without being asked to reload."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shmmap import CellSet, connect
from shmmap.events import EventStream
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, next_reload
from tests.support.divided_map import DividedMap, make_map, random_points


def test_what_is_written_is_served(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root, "--watch")
    with connect(one.endpoint) as client, EventStream(one.endpoint, timeout=30.0) as stream:
        old = client.selected([divided_map.id("0_0.pcd")], wait=30.0)[0].version
        divided_map.change("0_0.pcd", 5)
        reloaded = next_reload(stream)
        assert (reloaded.changed, reloaded.added, reloaded.removed, reloaded.error) == (1, 0, 0, "")
        newer = client.selected([divided_map.id("0_0.pcd")], wait=30.0)[0]
        assert newer.version != old
        assert len(newer.xyz) == 700

        corner = (60, 0)
        divided_map.write_cell("60_0.pcd", corner, random_points(np.random.default_rng(8), corner, 100))
        divided_map.remove_cell("0_-20.pcd")
        divided_map.write_metadata()
        added = removed = 0
        while (added, removed) != (1, 1):  # a slow machine may report it in parts
            reloaded = next_reload(stream)
            added, removed = added + reloaded.added, removed + reloaded.removed
        assert client.selected([divided_map.id("60_0.pcd")], wait=30.0)


def test_a_map_that_is_away_for_a_while(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    """Until another one is in its place the old one is served; then that one, and its changes too."""
    one = daemon(divided_map.root, "--watch")
    with connect(one.endpoint) as client, EventStream(one.endpoint, timeout=30.0) as stream:
        moved_away = divided_map.root.with_name("moved_away")
        divided_map.root.rename(moved_away)
        assert "no map" in next_reload(stream).error
        assert client.selected(["0_0.pcd"], wait=None).failed == ()
        next_map = make_map(divided_map.root.with_name("next"), columns=2, rows=2, seed=5)
        next_map.root.rename(divided_map.root)
        reloaded = next_reload(stream)
        assert (reloaded.error, reloaded.removed) == ("", 32)
        next_map.root = divided_map.root
        next_map.change("0_0.pcd", 7)
        assert next_reload(stream).changed == 1
        divided_map.change("0_0.pcd", 8)
        assert next_reload(stream).changed == 1


def test_without_the_setting_nothing_is_watched(served: DaemonProcess, divided_map: DividedMap) -> None:
    with connect(served.endpoint) as client, EventStream(served.endpoint, timeout=30.0) as stream:
        divided_map.change("0_0.pcd", 5)
        client.reload()
        assert next_reload(stream).changed == 1
        assert client.stats().counters["reloads"] == 1


# --- links ------------------------------------------------------------------------------------------

OLD, NEW = 500, 40
"""Points of each cell in the two maps."""


def switch(link: Path, target: str) -> None:
    """Have a link lead somewhere else, in one step."""
    interim = link.with_name(link.name + ".next")
    interim.symlink_to(target)
    interim.rename(link)


def map_itself(root: Path) -> tuple[Path, Callable[[], object]]:
    """``current`` leads to the map."""
    (root / "current").symlink_to("v1")
    return root / "current", lambda: switch(root / "current", "v2")


def parent(root: Path) -> tuple[Path, Callable[[], object]]:
    """``releases/current`` leads to a directory that has the map in it, by an absolute path."""
    for version in ("v1", "v2"):
        (root / "releases" / version).mkdir(parents=True)
        (root / version).rename(root / "releases" / version / "map")
    link = root / "releases" / "current"
    link.symlink_to(root / "releases" / "v1")
    return link / "map", lambda: switch(link, str(root / "releases" / "v2"))


def two_links(root: Path) -> tuple[Path, Callable[[], object]]:
    """A link leads to the link that is switched."""
    (root / "stable").symlink_to("v1")
    (root / "current").symlink_to("./stable")
    return root / "current", lambda: switch(root / "stable", "v2")


def cells_alone(root: Path) -> tuple[Path, Callable[[], object]]:
    """The map's directory stays, its directory of cells is a link."""
    (root / "map").mkdir()
    (root / "v1" / "pointcloud_map_metadata.yaml").rename(root / "map" / "pointcloud_map_metadata.yaml")
    link = root / "map" / "pointcloud_map.pcd"
    link.symlink_to("../v1/pointcloud_map.pcd")
    return root / "map", lambda: switch(link, "../v2/pointcloud_map.pcd")


def kubernetes(root: Path) -> tuple[Path, Callable[[], object]]:
    """A volume: each name is a link through ``..data``, which leads to a directory that is new each time."""
    volume = root / "volume"
    volume.mkdir()
    (root / "v1").rename(volume / "..2026_01")
    (root / "v2").rename(volume / "..2026_02")
    (volume / "..data").symlink_to("..2026_01")
    for name in ("pointcloud_map.pcd", "pointcloud_map_metadata.yaml"):
        (volume / name).symlink_to(f"..data/{name}")
    return volume, lambda: switch(volume / "..data", "..2026_02")


def flat_kubernetes(root: Path) -> tuple[Path, Callable[[], object]]:
    """The cells themselves are the links."""
    volume = root / "volume"
    volume.mkdir()
    for version, name in (("v1", "..2026_01"), ("v2", "..2026_02")):
        (root / version / "pointcloud_map.pcd").rename(volume / name)
        (root / version / "pointcloud_map_metadata.yaml").rename(
            volume / name / "pointcloud_map_metadata.yaml"
        )
    (volume / "..data").symlink_to("..2026_01")
    for name in os.listdir(volume / "..data"):
        (volume / name).symlink_to(f"..data/{name}")
    return volume, lambda: switch(volume / "..data", "..2026_02")


def renamed(root: Path) -> tuple[Path, Callable[[], object]]:
    """No link at all: the directory above gets another name, and another one gets its."""
    (root / "maps").mkdir()
    (root / "next").mkdir()
    (root / "v1").rename(root / "maps" / "map")
    (root / "v2").rename(root / "next" / "map")

    def exchange() -> None:
        (root / "maps").rename(root / "before")
        (root / "next").rename(root / "maps")

    return root / "maps" / "map", exchange


def removed(root: Path) -> tuple[Path, Callable[[], object]]:
    """The link is switched, and the old map removed at once."""
    (root / "current").symlink_to("v1")

    def go_on() -> None:
        switch(root / "current", "v2")
        shutil.rmtree(root / "v1")

    return root / "current", go_on


EXCHANGES = [map_itself, parent, two_links, cells_alone, kubernetes, flat_kubernetes, renamed, removed]


def sizes(cells: CellSet) -> set[int]:
    assert cells.pending == ()
    return {len(cell.xyz) for cell in cells}


@pytest.mark.parametrize(
    ("exchange", "watch"),
    [
        *((exchange, False) for exchange in EXCHANGES),
        *((exchange, True) for exchange in (map_itself, parent, kubernetes, removed)),
    ],
)
def test_a_link_that_leads_to_another_map(
    daemon: DaemonFactory,
    tmp_path: Path,
    exchange: Callable[..., tuple[Path, Callable[[], object]]],
    watch: bool,
) -> None:
    """One map after the other, never a mixture of both; ids stay the paths as given."""
    names = sorted(make_map(tmp_path / "v1", points=OLD).corners)
    make_map(tmp_path / "v2", points=NEW, seed=2)
    path, change = exchange(tmp_path)
    one = daemon(path, *(["--watch"] if watch else []))
    with connect(one.endpoint) as client, EventStream(one.endpoint, timeout=30.0) as stream:
        assert sizes(client.selected(names[:12], wait=30.0)) == {OLD}
        assert client.welcome.id_prefix.startswith(f"{path}/")
        change()
        if not watch and exchange is not removed:
            cells = client.selected(names, wait=30.0)  # most of them have not been read yet
            assert (len(cells), sizes(cells)) == (36, {OLD})
        if not watch:
            client.reload()
        while (reloaded := next_reload(stream)).error:
            pass  # it was looked for in between
        assert (reloaded.changed, reloaded.added, reloaded.removed) == (36, 0, 0)
        cells = client.selected(names, wait=30.0)
        assert (len(cells), sizes(cells)) == (36, {NEW})
        assert all(cell.id.startswith(f"{path}/") for cell in cells)
    assert "/proc/self/fd" not in one.log
