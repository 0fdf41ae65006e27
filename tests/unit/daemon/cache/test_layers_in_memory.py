# SPDX-License-Identifier: Apache-2.0
"""What computed layers cost the budget, and what they leave when they are gone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from shmmap.protocol import messages as m
from shmmap.protocol.messages import Selected
from tests.support.divided_map import make_map
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon

NDT = "ndt(leaf=5.0,min_points=3)"


def ask(one: InnerDaemon, session: Any, number: int, layer: str) -> m.Cells:
    ids = tuple(one.cache.catalogue.id(i) for i in range(len(one.cache.catalogue)))
    one.ask(session, Selected(number, ids, (layer,), 30.0))
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
    assert len(one.cache.warm.layers) == len(one.cache.warm.versions) == 3
    for resident in list(one.ledger.residents()):
        one.reclaimer.retire(resident, one.now_s())
    assert one.cache.warm.layers == {}
    assert one.cache.warm.versions == {}
    assert len(ask(one, session, 9, "voxel(leaf=1.0)").cells) == 2
