# SPDX-License-Identifier: Apache-2.0
"""The picture of a live map: where voxels, chunks and the path are, as an independent reader sees them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray
from shmmap_clients.rolling_map.live_map import usage_text
from shmmap_clients.rolling_map.picture import STATES, HeightColours, MapContent, map_picture

from shmmap.chunks.voxels import ChunkKey
from shmmap.live import ChunkInfo, LiveMapRow
from tests.support.pictures import SVG, rasters

RESOLUTION = 0.5
SIDE = 64 * RESOLUTION


def chunk(key: tuple[int, int, int], state: str) -> ChunkInfo:
    return ChunkInfo(ChunkKey(*key), state, 0, 0, 0, 4096, 1, 1)


def centers(*indices: tuple[int, ...]) -> NDArray[np.float64]:
    return (np.array(indices, np.float64).reshape(-1, 3) + 0.5) * RESOLUTION


def drawn(content: MapContent) -> ElementTree.Element:
    return ElementTree.fromstring(map_picture(content, "a < b", "note"))


def squares(root: ElementTree.Element) -> list[tuple[str, list[tuple[float, float, float]]]]:
    """Outline colour, and left, top and side of its squares; those of the legend are no paths."""
    found = []
    for path in root.iter(f"{SVG}path"):
        corners = re.findall(r"M([\d.]+) ([\d.]+)h([\d.]+)v", path.attrib["d"])
        if corners and path.attrib["fill"] == "none":
            places = [(float(x), float(y), float(side)) for x, y, side in corners]
            found.append((path.attrib["stroke"], places))
    return found


def test_north_and_up_are_at_the_top_and_the_highest_voxel_is_seen() -> None:
    low, high, north, free = (0, 0, -4), (0, 0, 6), (0, 9, 1), (5, 0, 0)
    content = MapContent(RESOLUTION, centers(high, low, north), centers(free, low))
    (above, _), (side, _) = rasters(drawn(content))
    assert above.shape == (10, 6, 4)
    assert side.shape == (11, 6, 4)
    colours = HeightColours.of(content.occupied[:, 2])
    of_low, of_high, of_north = colours.rgb(centers(low, high, north)[:, 2]).tolist()
    assert above[9, 0].tolist() == [*of_high, 255], "the highest of its column, whatever the order"
    assert above[0, 0].tolist() == [*of_north, 255], "north is up"
    assert side[0, 0].tolist() == [*of_high, 255], "up is up"
    assert side[10, 0].tolist() == [*of_low, 255], "occupied hides free"
    assert 0 < above[9, 5, 3] < 255, "chunks are seen through what is free"
    assert above[5, 3, 3] == 0, "nothing is known there"


def test_heights_never_look_like_clean_or_dirty_chunks() -> None:
    red, green, blue = HeightColours(0.0, 1.0).levels.astype(int).T
    assert ((red >= green) | (blue > green)).all()
    assert (np.diff(red) >= -5).all()
    colours = HeightColours.of(np.full(9, 3.0))
    assert colours.rgb(np.array([-1e9, 3.0, 1e9])).shape == (3, 3)


@pytest.mark.parametrize("key", [(0, 0, 0), (-3, 2, -1)])
def test_voxels_lie_in_their_chunk(key: tuple[int, int, int]) -> None:
    first = tuple(64 * part for part in key)
    last = tuple(64 * part + 63 for part in key)
    content = MapContent(RESOLUTION, centers(first, last), chunks=[chunk(key, "dirty")])
    root = drawn(content)
    views = rasters(root)
    assert len(views) == 2
    boxes = [box for colour, found in squares(root) for box in found if colour == STATES["dirty"].colour]
    for (_, image), (x, y, size) in zip(views, boxes, strict=True):
        assert image == pytest.approx([x, y, size, size], abs=0.05)


def test_chunks_have_the_colours_of_rolling_bonxai() -> None:
    rows = [chunk((at, 0, 0), state) for at, state in enumerate(STATES)]
    root = drawn(MapContent(RESOLUTION, chunks=rows))
    seen = dict(squares(root))
    assert seen.keys() == {look.colour for look in STATES.values()}
    order = sorted(seen, key=lambda colour: seen[colour][0][0])
    assert order == [look.colour for look in STATES.values()]
    text = " ".join(element.text or "" for element in root.iter(f"{SVG}text"))
    assert all(look.text in text for look in STATES.values())

    def rgb(state: str) -> tuple[int, int, int]:
        red, green, blue = bytes.fromhex(STATES[state].colour[1:])
        return red, green, blue

    assert max(rgb("clean")) == rgb("clean")[1], "green"
    assert max(rgb("dirty")) == rgb("dirty")[2], "blue"
    assert max(rgb("loading")) < 40, "black"
    assert STATES["saved"].opacity == 0.0, "an outline alone"


def test_of_chunks_above_one_another_the_most_urgent_state_is_seen() -> None:
    rows = [chunk((0, 0, at), state) for at, state in enumerate(("saved", "dirty", "clean"))]
    root = drawn(MapContent(RESOLUTION, chunks=rows))
    found = squares(root)
    assert sum(len(places) for _, places in found) == 1 + 3, "one from above, three from the south"
    assert found[0][0] == STATES["dirty"].colour


def test_only_what_is_chosen_is_in_the_legend() -> None:
    def words(content: MapContent) -> str:
        return " ".join(element.text or "" for element in drawn(content).iter(f"{SVG}text"))

    nothing = words(MapContent(RESOLUTION))
    assert "a < b" in nothing
    for word in ("chunks", "height", "free", "path"):
        assert word not in nothing
    assert "height" in words(MapContent(RESOLUTION, occupied=centers((0, 0, 0))))
    assert "free" in words(MapContent(RESOLUTION, free=centers((0, 0, 0))))
    path = MapContent(RESOLUTION, path=[(0.0, 0.0, 1.0), (3.0, 4.0, 1.0)], usage="7 voxels known, 1 < 2 MB")
    assert "sensor's path" in words(path)
    assert "7 voxels known, 1 < 2 MB" in words(path)


def test_the_path_is_where_the_sensor_was() -> None:
    key = (2, -1, 0)
    middle = tuple((part + 0.5) * SIDE for part in key)
    root = drawn(MapContent(RESOLUTION, chunks=[chunk(key, "clean")], path=[middle]))  # type: ignore[list-item]
    boxes = [box for _, found in squares(root) for box in found]
    points = [line.attrib["points"] for line in root.iter(f"{SVG}polyline")][::2]
    for (left, top, size), place in zip(boxes, points, strict=True):
        x, y = map(float, place.split(","))
        assert (x, y) == pytest.approx((left + size / 2, top + size / 2), abs=0.1)


def test_a_large_map_is_made_coarser() -> None:
    content = MapContent(0.05, np.array([[0.025, 0.025, 0.025], [1000.025, 600.025, 3.025]]))
    (above, _), _ = rasters(drawn(content))
    assert max(above.shape) <= 2400
    assert above[-1, 0, 3] == above[0, -1, 3] == 255
    assert drawn(MapContent(1e-3, path=[(0.0, 0.0, 0.0)])) is not None, "and a very small one is drawn"


def test_the_size_of_a_map_in_words() -> None:
    row = LiveMapRow("lidar", "/live", 0.1, "map", 12, 1_234_567, 4 << 20, 0, 0, 0, 1 << 20, 0, 0, 0, 0, 0)
    assert usage_text(row) == "1,234,567 voxels known, 4.0 MiB, 12 chunks, 1.0 MiB waiting"
    one = replace(row, chunks=1, active=1, waiting_bytes=0)
    assert usage_text(one) == "1 voxel known, 4.0 MiB, 1 chunk"
