# SPDX-License-Identifier: Apache-2.0
"""No request asks for so much that others wait long for it; what it says is bounded before it is kept."""

from __future__ import annotations

import math

import pytest

from shmmap.daemon.requests import limits
from shmmap.errors import BadRequest, Busy
from shmmap.layers import versions as layer_versions
from shmmap.protocol.messages import Area, Differential, HeldCell, Intent, Selected
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import EVERYWHERE, Inner


def test_cells_of_one_request(inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    one = inner(small_map.root)
    monkeypatch.setattr(limits, "MAX_CELLS", 15)
    with pytest.raises(BadRequest, match="more than 15 cells in one request"):
        one.ask(one.session(), Area(1, EVERYWHERE))
    with pytest.raises(BadRequest, match="more than 15 cells"):  # known or not
        one.ask(one.session(), Selected(2, ("nowhere",) * 16))
    assert not one.loads.by_key
    assert not one.ledger.by_key
    assert one.replies == []


def test_what_a_client_says_it_holds(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    many = limits.MAX_HELD
    for message in (
        Differential(1, EVERYWHERE, held=(HeldCell("a"),) * (many + 1)),
        Differential(1, EVERYWHERE, packed=bytes(8 * (many + 1))),
        Differential(1, EVERYWHERE, held=(HeldCell("a", 1, ("points",) * (many + 1)),)),
        Differential(
            1, EVERYWHERE, held=(HeldCell("a", 1, tuple(f"voxel(leaf={1 + n / 100})" for n in range(65))),)
        ),
    ):
        with pytest.raises(BadRequest, match="held"):
            one.ask(one.session(), message)
    one.ask(one.session(), Differential(2, EVERYWHERE, packed=bytes(8 * many)))
    assert len(one.replies) == 1


def test_loads_that_one_process_waits_for(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asking again for the same ones is no more of them; others' loads do not count."""
    monkeypatch.setattr(limits, "MAX_QUEUED", 5)
    one = inner(small_map.root)
    with one.loaders_standing_still():
        greedy, other = one.session(), one.session()
        one.ask(greedy, Area(1, EVERYWHERE))
        assert len(one.cells_of(1).pending) == 16
        one.ask(greedy, Area(2, EVERYWHERE))
        assert len(one.cells_of(2).pending) == 16
        with pytest.raises(Busy, match="5 loads"):
            one.ask(greedy, Area(3, EVERYWHERE, ("voxel(leaf=1.0)",)))
        one.ask(other, Area(4, EVERYWHERE, ("voxel(leaf=1.0)",)))
        assert len(one.cells_of(4).pending) == 16
    one.run_until(lambda: not len(one.loads))
    one.ask(greedy, Area(5, EVERYWHERE, ("voxel(leaf=2.0)",), 30.0))
    assert len(one.cells_of(5).cells) == 16


def test_layers(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root)
    session = one.session()
    with pytest.raises(BadRequest, match="17 layers in one request"):
        one.ask(session, Area(1, EVERYWHERE, ("points",) * 17))


def test_a_layer_that_would_look_into_too_many_cells(
    inner: Inner, small_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(layer_versions, "MAX_NEIGHBOURS", 5)
    one = inner(small_map.root)
    for message in (
        Area(1, EVERYWHERE, ("points", "normals(radius=10)")),
        Differential(2, EVERYWHERE, ("normals(radius=10)",)),
        Selected(3, ("0_0.pcd",), ("denoise(halo=10)",)),
    ):
        with pytest.raises(BadRequest, match="would look into about 9 cells around each one"):
            one.ask(one.session(), message)
    assert not one.loads.by_key


def test_intents() -> None:
    limits.check_intent(Intent(1.0, 2.0, route=((3.0, 4.0),)))
    for wrong in (
        Intent(math.nan, 0.0),
        Intent(0.0, 0.0, heading=math.inf),
        Intent(0.0, 0.0, route=((0.0, math.nan),)),
    ):
        with pytest.raises(BadRequest, match="finite"):
            limits.check_intent(wrong)
