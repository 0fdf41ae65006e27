# SPDX-License-Identifier: Apache-2.0
"""Whether what the daemon handed out is what the map's files hold."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

import shmmap
from shmmap.errors import LoadFailed
from tests.support.divided_map import DividedMap
from tests.support.patience import Patience
from tests.support.raw_client import RawClient, RawHandle
from tests.support.segment_reader import read_segment


def names(cells: Iterable[Any]) -> list[str]:
    """File names of cells, or of handles."""
    return [cell.id.rsplit("/", 1)[-1] for cell in cells]


def assert_same_points(client: RawClient, handle: RawHandle, made: DividedMap) -> None:
    """The segment holds exactly what an independent reader finds in the file."""
    name = handle.id.rsplit("/", 1)[1]
    segment = read_segment(client.path(handle))
    source = made.points(name)
    expected = np.column_stack([source["x"], source["y"], source["z"]])
    assert segment.columns["xyz"].tobytes() == expected.tobytes()
    assert segment.columns["intensity"].tobytes() == source["intensity"].tobytes()
    assert segment.fields["cell_id"] == made.id(name) == handle.id
    assert segment.fields["box"] == made.box(name) == handle.box
    assert (segment.epoch, segment.version) == (client.epoch, handle.version)
    assert handle.points == segment.fields["rows"] == len(expected)
    assert segment.fields["dropped_points"] == 0


def assert_right(cells: shmmap.CellSet, made: DividedMap, wanted: list[str]) -> None:
    """All of them are there, each with exactly its file's bytes."""
    assert sorted(cell.id.rsplit("/", 1)[1] for cell in cells) == wanted
    for cell in cells:
        expected = made.points(cell.id.rsplit("/", 1)[1])
        assert cell.xyz[:, 0].tobytes() == expected["x"].tobytes()
        assert cell["intensity"].tobytes() == expected["intensity"].tobytes()


def whole(client: shmmap.Client, x: float, y: float, radius: float) -> shmmap.CellSet:
    """Ask until every cell is there: one that a loader died of is retried."""
    found = client.around(x, y, radius, wait=30.0)
    waiting = Patience()
    while waiting(not found.complete):
        assert all(isinstance(failure, LoadFailed) for failure in found.failed), found
        found = client.around(x, y, radius, wait=30.0)
    return found
