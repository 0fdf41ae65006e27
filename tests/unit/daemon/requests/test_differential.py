# SPDX-License-Identifier: Apache-2.0
"""What a client lacks and should drop, against a brute-force oracle written from Autoware's semantics.

In Autoware (``create_differential_map_load_plan``) the cells of the area are walked in id order: one
whose id is cached is kept, any other is new; cached ids that were never matched are to be removed, in
the order given, unknown ones included.  Ours differ in four points, each in the oracle below: entries carry
versions (a cell held at another version is new and not removed), layers are held one by one, a
duplicate is named once, and versions alone may stand for cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.records import Key
from shmmap.daemon.requests.differential import Difference, difference, holds_few, warm_difference
from shmmap.errors import BadRequest
from shmmap.layers import versions as layer_versions
from shmmap.protocol.codec import pack_versions, unpack_versions
from shmmap.protocol.messages import MAX_NAMED, Area, BoxMessage, Differential, HeldCell
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.unit.daemon.inner_daemon import InnerDaemon

COLD = "20_20.pcd"
BROKEN = "20_0.pcd"
CHANGED = "0_0.pcd"
EVERYWHERE = BoxMessage(-1e3, -1e3, 1e3, 1e3)


@dataclass
class Served:
    """A daemon in which one cell is cold, one is broken after a change and one changed and loaded again."""

    inner: InnerDaemon
    made: DividedMap
    names: list[str]
    current: dict[str, int]
    old: dict[str, int]


def ask(inner: InnerDaemon, request: int, area: BoxMessage) -> dict[str, int]:
    """Ask for an area, wait; return the versions of the cells that came."""
    return {
        cell.id: cell.version
        for cell in inner.cells_for(Area(request, area, wait=30.0)).cells
        if not cell.stale
    }


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    root = tmp_path_factory.mktemp("difference")
    made: DividedMap = make_map(root / "map", columns=4, rows=4, points=30)
    inner = InnerDaemon(str(made.root), cache_dir=str(root / "cache"))
    before = ask(inner, 1, EVERYWHERE)
    for name, seed in ((CHANGED, 3), (BROKEN, 4)):
        corner = made.corners[name]
        made.write_cell(name, corner, random_points(np.random.default_rng(seed), corner, 20))
    path = Path(made.id(BROKEN))
    path.write_bytes(path.read_bytes()[:-9])
    inner.reload()
    after = ask(inner, 2, EVERYWHERE)
    names = sorted(made.corners)
    inner.reclaimer.retire(inner.cache.warm.layers["points"][names.index(COLD)], inner.now_s() - 1.0)
    inner.run_until(lambda: not inner.ledger.retired)
    assert set(before) == set(names)
    assert set(after) == set(names) - {BROKEN}
    assert [name for name in names if after.get(name) != before[name]] == [CHANGED, BROKEN]
    catalogue = inner.cache.catalogue
    current = {name: catalogue.version(index) for index, name in enumerate(names)}
    yield Served(inner, made, names, current, before)
    inner.close()


def find(cache: CellCache, message: Differential, indices: list[int], layers: tuple[str, ...]) -> Difference:
    """Find the difference."""
    return difference(cache, message, np.array(indices, dtype=np.intp), layers)


def oracle(
    served: Served, inside: list[str], held: list[HeldCell], packed: list[int], layers: tuple[str, ...]
) -> tuple[list[tuple[str, str]], list[str], set[int], set[str]]:
    """New (name, layer), removed ids, removed versions, and names held at another version."""
    version_of = served.current
    by_path = {served.made.id(name): name for name in served.names} | {name: name for name in served.names}
    has: set[tuple[str, str]] = set()
    other: set[str] = set()
    removed: list[str] = []
    for cell in held:
        name = by_path.get(cell.id)
        if name not in inside:
            if cell.id not in removed:
                removed.append(cell.id)
        elif cell.version is not None and cell.version != version_of[name]:
            other.add(name)
        else:
            has |= {(name, layer) for layer in (layers if cell.layers is None else cell.layers)}
    for name in inside:
        if version_of[name] in packed:
            has |= {(name, layer) for layer in layers}
    new = [(name, layer) for name in inside for layer in layers if (name, layer) not in has]
    known = {served.old[name]: name for name in served.names}
    gone = set()
    for version in packed:
        if version in known and known[version] in inside and version != version_of[known[version]]:
            other.add(known[version])  # the daemon remembers it: replaced, not removed
        elif version not in [version_of[name] for name in inside]:
            gone.add(version)
    return new, removed, gone, other


NAMES = [f"{x}_{y}.pcd" for x in (-40, -20, 0, 20) for y in (-40, -20, 0, 20)]


@st.composite
def requests(draw: st.DrawFn) -> tuple[list[str], list[tuple[str, str, str, bool]], list[tuple[str, str]]]:
    """Cells inside; held rows (name, spelling, version, layers given); packed (name, version)."""
    warm_only = draw(st.booleans())
    pool = [name for name in NAMES if not warm_only or name not in (COLD, BROKEN)]
    inside = draw(st.lists(st.sampled_from(pool), unique=True))
    versions = st.sampled_from(["current", "old", "none", "unknown"][: 2 if warm_only else 4])
    names = st.sampled_from([*NAMES, "nowhere.pcd", "/elsewhere/x.pcd"])
    rows = st.tuples(names, st.sampled_from(["base", "whole"]), versions, st.booleans())
    held = draw(st.lists(rows, max_size=12))
    packed = draw(st.lists(st.tuples(st.sampled_from(NAMES), st.sampled_from(["current", "old", "unknown"]))))
    return sorted(inside), [(n, s, v, lay and not warm_only) for n, s, v, lay in held], packed


@settings(max_examples=200, deadline=None)
@given(requests())
def test_any_request(
    served: Served, request_: tuple[list[str], list[tuple[str, str, str, bool]], list[tuple[str, str]]]
) -> None:
    inside, rows, packed_rows = request_
    layers = ("points",)

    def version(name: str, kind: str) -> int | None:
        if kind == "none":
            return None
        if kind == "unknown" or name not in served.current:
            return 0xABCDEF + NAMES.index(name) if name in NAMES else 99
        return served.current[name] if kind == "current" else served.old[name]

    held = [
        HeldCell(
            served.made.id(name) if spelling == "whole" and name in NAMES else name,
            version(name, kind),
            layers if given_layers else None,
        )
        for name, spelling, kind, given_layers in rows
    ]
    packed = [version(name, kind) or 0 for name, kind in packed_rows]
    message = Differential(1, EVERYWHERE, layers, tuple(held), pack_versions(packed))
    indices = [served.names.index(name) for name in inside]
    cache = served.inner.cache

    found = find(cache, message, indices, layers)
    new, removed, gone, other = oracle(served, inside, held, packed, layers)
    assert [(served.names[index], layer) for index, layer in found.cells] == new
    assert list(found.removed) == removed
    removed_versions = unpack_versions(found.removed_packed)
    assert set(removed_versions) == gone
    assert len(removed_versions) == len(gone), "each once"
    assert {(Path(key.cell_id).name, key.layer) for key in found.held_old} == {
        (name, "points") for name in other
    }

    warm = warm_difference(cache, message, np.array(indices, dtype=np.intp), "points")
    all_warm = not {COLD, BROKEN} & set(inside)
    if all_warm and all(cell.version is not None and cell.layers is None for cell in held):
        assert warm is not None, "nearly every request is answered like this"
    if warm is not None:
        assert all_warm
        assert [resident.version for resident in warm.residents] == [served.current[name] for name, _ in new]
        assert [Path(resident.key.cell_id).name for resident in warm.residents] == [name for name, _ in new]
        assert list(warm.removed) == removed
        assert sorted(unpack_versions(warm.removed_packed)) == sorted(gone)


def test_a_version_stands_for_its_layer(served: Served) -> None:
    """Packed or named, and whatever other layers are asked for."""
    name, layers = "-20_-20.pcd", ("points", "voxel(leaf=1.0)", "denoise")
    index, cache = served.names.index(name), served.inner.cache
    points, voxel, denoise = (cache.layers.version(index, layer) for layer in layers)
    key = {layer: Key(cache.catalogue.id(index), layer) for layer in layers}
    for held, packed, lacks, old in (
        ([], [points], layers[1:], []),
        ([], [points, denoise], layers[1:2], []),
        ([], [points, voxel, denoise], (), []),
        ([HeldCell(name, voxel)], [denoise], layers[:1], []),
        ([HeldCell(name, voxel), HeldCell(name, points)], [], layers[2:], []),
        ([HeldCell(name, 99)], [], layers, [*layers]),
        ([HeldCell(name, points, layers[1:2])], [], layers, [*layers[1:2]]),
        ([HeldCell(name, points, ("crop(z_max=1.0)",))], [], layers, []),
        ([HeldCell(name, points, (layers[0], layers[0]))], [], layers[1:], []),
        ([HeldCell(name, None, layers[1::-1])], [], layers[2:], []),
    ):
        message = Differential(1, EVERYWHERE, layers, tuple(held), pack_versions(packed))
        found = find(cache, message, [index], layers)
        assert found.cells == [(index, layer) for layer in lacks]
        assert found.held_old == {key[layer] for layer in old}
        assert (found.removed, found.removed_packed) == ((), b"")


def test_a_cell_held_in_another_layer_alone_is_lacking(served: Served) -> None:
    """Also where all that is asked for is in memory, which is the quicker way."""
    name = "-20_-20.pcd"
    held = HeldCell(name, served.current[name], ("voxel(leaf=1.0)",))
    message = Differential(1, EVERYWHERE, ("points",), (held,))
    rows = np.array([served.names.index(name)], dtype=np.intp)
    warm = warm_difference(served.inner.cache, message, rows, "points")
    assert warm is None or [resident.version for resident in warm.residents] == [held.version]


@pytest.mark.parametrize("packed", [b"1234567", b"123456789"])
def test_packed_versions_of_broken_length(served: Served, packed: bytes) -> None:
    message = Differential(1, EVERYWHERE, packed=packed)
    with pytest.raises(BadRequest):
        find(served.inner.cache, message, [0], ("points",))
    with pytest.raises(BadRequest):
        warm_difference(served.inner.cache, message, np.array([0], dtype=np.intp), "points")


def test_very_many_held(served: Served) -> None:
    """As many as a request may name, all but one of them unknown: each is to be dropped, in their order."""
    rows = [HeldCell(f"gone/{number}.pcd", number + 1) for number in range(MAX_NAMED - 1)]
    rows.insert(1000, HeldCell("0_0.pcd", served.current["0_0.pcd"]))
    index = served.names.index("0_0.pcd")
    message = Differential(1, EVERYWHERE, held=tuple(rows))
    expected = [row.id for row in rows if row.id != "0_0.pcd"]
    found = find(served.inner.cache, message, [index], ("points",))
    assert (found.cells, list(found.removed)) == ([], expected)
    assert not holds_few(message)


def test_very_many_packed(served: Served) -> None:
    """Versions of every first digit, each twice, and those of the map among them: as the oracle says."""
    inside = [name for name in served.names if name not in (BROKEN, NAMES[0])]
    spread = [(number % 16 << 60) | number + 1 for number in range(9_000)]
    packed = [*spread, *spread, *served.current.values(), *served.old.values()]
    message = Differential(1, EVERYWHERE, packed=pack_versions(packed))
    indices = [served.names.index(name) for name in inside]
    cache = served.inner.cache
    assert not holds_few(message)
    found = find(cache, message, indices, ("points",))
    new, _, gone, other = oracle(served, inside, [], [*set(packed)], ("points",))
    assert [(served.names[index], layer) for index, layer in found.cells] == new == []
    removed = unpack_versions(found.removed_packed)
    assert (set(removed), len(removed)) == (gone, len(gone))
    assert {Path(key.cell_id).name for key in found.held_old} == other == {CHANGED}


@pytest.mark.parametrize("most", [1, 3, 5, 100])
def test_from_any_place_on(served: Served, most: int) -> None:
    """Part after part, each of whole cells, the parts are the whole."""
    layers, cache = ("points", "voxel(leaf=1.0)"), served.inner.cache
    area = np.arange(16)
    held = [served.current[name] for name in served.names[2:9]]
    message = Differential(1, EVERYWHERE, packed=pack_versions(held))
    whole = difference(cache, message, area, layers)
    assert (len(whole.cells), whole.looked_at) == (32 - 7, 16)
    found, start = list[tuple[int, str]](), 0
    while start < 16:
        part = difference(cache, message, area, layers, start=start, most=most)
        assert len(part.cells) <= most + 1
        start += part.looked_at
        assert all(index < start for index, _ in part.cells)
        found += part.cells
    assert found == whole.cells


def test_versions_that_take_long_are_found_some_at_a_time(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is unknown by then is neither lacked nor dropped."""
    layers, cache = ("denoise",), served.inner.cache
    area, versions = np.arange(16), [cache.layers.version(index, "denoise") for index in range(16)]
    message = Differential(1, EVERYWHERE, packed=pack_versions([*versions[1:], 77]))
    cache.layers.forget()
    monkeypatch.setattr(layer_versions, "COMPUTED_PER_BATCH", 3 * layer_versions.HALO_COST)
    first = difference(cache, message, area, layers)
    assert (first.cells, first.looked_at, first.removed_packed) == ([(0, "denoise")], 3, b"")
    start = first.looked_at
    while start < 16:
        part = difference(cache, message, area, layers, start=start)
        assert part.cells == []
        start += part.looked_at
    assert part.removed_packed == pack_versions([77])
