# SPDX-License-Identifier: Apache-2.0
"""The build of a whole map: cells that are left out, and how an interrupted one continues."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.elevation_map.build import Checkpoint, Journal, _alone, far_cells
from shmmap_clients.elevation_map.seams import Columns, Seams


def squares(*corners: tuple[float, float], edge: float = 20.0) -> NDArray[np.float64]:
    low = np.array(corners, np.float64)
    return np.hstack([low, low + edge])


TOWN = [(x, y) for x in (0, 20, 40) for y in (0, 20, 40)]


@pytest.mark.parametrize(
    ("stray", "metres"),
    [
        ([(9000, 0)], [8940.0]),
        ([(-6420, -6420)], [9050.97]),
        ([(0, 90_000), (90_000, 0), (90_020, 0)], [89_940.0, 89_940.0, 89_960.0]),
        ([(5e6, 5e6)], [7.0709831e6]),
    ],
)
def test_a_stray_cell_is_far(stray: list[tuple[float, float]], metres: list[float]) -> None:
    boxes = squares(*TOWN, *stray)
    sizes = np.array([100_000] * 9 + [250] * len(stray))
    order = np.random.default_rng(0).permutation(len(boxes))
    far = far_cells(boxes[order], sizes[order])[np.argsort(order)]
    assert far[:9].tolist() == [0.0] * 9
    assert far[9:] == pytest.approx(metres, rel=1e-6)


@pytest.mark.parametrize(
    ("others", "size"),
    [
        ([(9000, 0)], 100_000),  # a part of a map, not a point
        ([(300, 0)], 250),  # near
        ([(900 * n, 0) for n in range(1, 12)], 250),  # a road leads there
        ([], 250),
    ],
)
def test_what_belongs_to_the_map_stays(others: list[tuple[float, float]], size: int) -> None:
    boxes = squares(*TOWN, *others)
    sizes = np.array([100_000] * 9 + [size] * len(others))
    assert not far_cells(boxes, sizes).any()
    # one cell and one stray point beside it; equal ones are both kept
    two = squares((0, 0), (9000, 9000))
    assert (far_cells(two, np.array([50_000, 300])) > 0).tolist() == [False, True]
    assert not far_cells(two, np.array([300, 300])).any()
    assert not far_cells(two, np.array([0, 0])).any()


def test_a_checkpoint_brings_back_what_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = np.array([(0, 0, 5, 5), (4, 0, 9, 5), (8, 0, 12, 5)])

    def rows(*i: int) -> Columns:
        values: NDArray[Any] = np.array([[n, 0.5, 1.5] for n in i], np.float32)
        return Columns(np.array(i), np.full(len(i), 2), values)

    seams, journal = Seams(boxes), Journal(tmp_path)
    assert journal.read(seams) is None
    (tmp_path / "heights").touch()
    seams.add(0, rows(1, 4))
    journal.write(Checkpoint(1, 2, 0), seams)
    seams.add(1, rows(4, 8))
    forced = []

    def fsync(fd: int) -> None:
        assert json.loads((tmp_path / "state.json").read_text())["done"] == 1  # the state comes last
        forced.append(Path(os.readlink(f"/proc/self/fd/{fd}")).name)

    monkeypatch.setattr(os, "fsync", fsync)
    journal.write(Checkpoint(2, 4, 1), seams)
    assert sorted(forced) == ["heights", "seams-2.npz"]
    again = Seams(boxes)
    assert journal.read(again) == Checkpoint(2, 4, 1)
    assert sorted(path.name for path in tmp_path.glob("seams-*")) == ["seams-2.npz"]
    released = again.add(2, rows(8, 11))
    assert released is not None
    assert sorted(released.values[:, 0].tolist()) == [8, 8, 11]
    (tmp_path / "seams-2.npz").write_bytes(b"torn")
    assert journal.read(Seams(boxes)) is None


@pytest.mark.parametrize("planted", ["link", "writable", "lock"])
def test_a_planted_directory_of_the_cache_is_refused(tmp_path: Path, planted: str) -> None:
    """Nothing is emptied, and a file to which the lock leads is not cut."""
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "mine").write_text("mine")
    cache = tmp_path / "cache"
    cache.mkdir()
    if planted == "link":
        (cache / "key").symlink_to(victim)
    elif planted == "lock":
        (cache / "key.lock").symlink_to(victim / "mine")
    else:
        (cache / "key").mkdir()
        (cache / "key").chmod(0o777)
    with pytest.raises(OSError, match=r"key"), _alone(cache, "key"):
        pytest.fail("it was taken")
    assert (victim / "mine").read_text() == "mine"
