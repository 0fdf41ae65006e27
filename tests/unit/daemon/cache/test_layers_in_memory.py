# SPDX-License-Identifier: Apache-2.0
"""What computed layers cost the budget, and what they leave when they are gone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shmmap.daemon.cache import warm_index
from shmmap.daemon.records import Key
from shmmap.protocol import messages as m
from shmmap.protocol.messages import Selected
from tests.support.divided_map import make_map
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon

pytestmark = pytest.mark.usefixtures("layer_kernels")
NDT = "ndt(leaf=5.0,min_points=3)"


def ask(one: InnerDaemon, session: Any, number: int, layer: str) -> m.Cells:
    ids = tuple(one.cache.catalogue.id(i) for i in range(len(one.cache.catalogue)))
    one.ask(session, Selected(number, ids, (layer,), 600.0))
    return one.cells_of(number)


def test_ndt_is_served_where_its_points_would_never_fit(tmp_path: Path, inner: Inner) -> None:
    made = make_map(tmp_path / "map", columns=2, rows=2, points=20_000)
    one = inner(made.root, budget_bytes=1 << 20)
    one.ledger.budget_bytes = one.ledger.overhead_bytes + 400_000  # each file alone has 320 kB
    session = one.session()
    reply = ask(one, session, 1, NDT)
    assert (len(reply.cells), reply.failed) == (4, ())
    assert one.ledger.used_bytes <= one.ledger.budget_bytes
    assert {key.layer for key in {*one.ledger.by_key, *one.loads.by_key, *one.loads.failures}} == {NDT}


def test_forgotten_layers_leave_no_tables(tmp_path: Path, inner: Inner) -> None:
    made = make_map(tmp_path / "map", columns=2, rows=1, points=50)
    one = inner(made.root)
    session = one.session()
    for number in range(1, 4):
        ask(one, session, number, f"voxel(leaf={number}.0)")
    assert len(one.cache.warm.layers) == len(one.cache.warm.tables) == 3
    for resident in list(one.ledger.residents()):
        one.reclaimer.retire(resident, one.now_s())
    assert one.cache.warm.layers == {}
    assert one.cache.warm.tables == {}
    assert len(ask(one, session, 9, "voxel(leaf=1.0)").cells) == 2


def test_any_number_of_layers_is_in_memory(
    tmp_path: Path, inner: Inner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tables are for those with the most segments; the others are found without, and none is refused."""
    monkeypatch.setattr(warm_index, "TABLES_BYTES", 0)
    monkeypatch.setattr(warm_index, "LEAST_TABLES", 2)
    made = make_map(tmp_path / "map", columns=4, rows=2, points=50)
    one = inner(made.root)
    first, session, warm = (made.id("0_0.pcd"),), one.session(), one.cache.warm
    layers = [f"voxel(leaf={number}.0)" for number in range(1, 9)]
    for number, layer in enumerate(layers):
        one.ask(session, Selected(number + 1, first, (layer,), 600.0))
        assert len(one.cells_of(number + 1).cells) == 1
    assert set(warm.layers) == set(layers)
    assert list(warm.tables) == layers[:2]
    assert len(ask(one, session, 20, "points").cells) == 8  # one at a time, of a layer that came last
    assert "points" in warm.tables
    assert len(warm.tables) == 2
    everything = np.arange(8)
    for layer in ("points", *layers):
        current = [one.cache.layers.version(index, layer) for index in range(8)]
        expected = [version if warm.get(index, layer) else 0 for index, version in enumerate(current)]
        assert warm.versions(layer, everything) == expected
    assert len(warm) == 16
    one.reclaimer.retire(one.ledger.by_key[Key(first[0], layers[5])], one.now_s())
    assert warm.versions(layers[5], everything) is None
    assert len(warm) == 15


def test_what_old_versions_are_of_is_forgotten_some_day(
    tmp_path: Path, inner: Inner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warm_index, "RETIRED_REMEMBERED", 3)
    made = make_map(tmp_path / "map", columns=4, rows=2, points=50)
    one = inner(made.root)
    versions = [cell.version for cell in ask(one, one.session(), 1, "points").cells]
    residents = [one.ledger.by_key[Key(one.cache.catalogue.id(i), "points")] for i in range(8)]
    for resident in residents[:5]:
        one.reclaimer.retire(resident, one.now_s())
    assert set(one.cache.warm.of_version) == set(versions[2:])
    assert len(ask(one, one.session(), 2, "points").cells) == 8  # loaded again, or put back in service
    assert set(one.cache.warm.of_version) == set(versions)
    for resident in residents[5:]:
        one.reclaimer.retire(resident, one.now_s())
    assert set(one.cache.warm.of_version) == set(versions)
