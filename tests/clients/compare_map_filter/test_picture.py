# SPDX-License-Identifier: Apache-2.0
"""The picture of a filtered drive as an independent reader sees it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from shmmap_clients.compare_map_filter.output import TopView

from tests.support.pictures import SVG, rasters


@pytest.mark.parametrize("shift", [(0.0, 0.0), (-2.0, -50.0), (89_000.0, -1.0)])
def test_kept_points_are_red_on_top_of_grey(shift: tuple[float, float]) -> None:
    view = TopView(0.5)
    xyz = np.array([[0.1, 0.1, 0], [0.2, 0.2, 0], [5.1, 0.1, 0], [0.1, 3.1, 0], [np.nan, 0, 0], [1e30, 0, 0]])
    xyz[:, :2] += shift
    view.add(xyz, np.array([True, False, False, False, True, True]), (2.0, 1.0))
    root = ElementTree.fromstring(view.svg("a < b", "note"))
    assert root.find(f"{SVG}title") is not None
    ((image, _),) = rasters(root)
    assert image.shape[:2] == (7, 11)
    colours = {tuple(colour) for colour in image.reshape(-1, 4).tolist()}
    assert colours == {(0, 0, 0, 0), (178, 186, 194, 255), (214, 40, 40, 255)}
    reds = np.argwhere((image == (214, 40, 40, 255)).all(axis=2))
    greys = np.argwhere((image == (178, 186, 194, 255)).all(axis=2))
    assert len(reds) == 1
    assert sorted((greys - reds[0]).tolist()) == [[-6, 0], [0, 10]]  # north is up


def test_a_picture_of_nothing() -> None:
    ElementTree.fromstring(TopView().svg("nothing", ""))


def test_a_long_drive_takes_no_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmmap_clients.compare_map_filter.output._MOST", 500)
    fine, view = np.random.default_rng(3).uniform(-40, 40, (4000, 3)), TopView(0.1)
    kept = fine[:, 0] > 0
    for part in range(0, 4000, 400):
        view.add(fine[part : part + 400], kept[part : part + 400], (0.0, 0.0))
    assert len(view._kept) + len(view._removed) <= 500
    whole = TopView(view._pixel)
    whole.add(fine, kept, (0.0, 0.0))
    assert np.array_equal(view._kept + (_shift(whole) - _shift(view)), whole._kept)
    assert view.svg("a", "b").count("<image") == 1


def _shift(view: TopView) -> int:
    """What the offset of a view's indices makes of its packed pixels."""
    return (view._offset << 32) + view._offset
