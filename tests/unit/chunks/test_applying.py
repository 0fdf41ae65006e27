# SPDX-License-Identifier: Apache-2.0
"""Evidence has its worth and adds up as in a slow reference; a dead writer leaves a chunk as it was."""

from __future__ import annotations

import math

import numpy as np
import pytest

from shmmap.chunks import applying
from shmmap.chunks.layout import MAPPERS, ChunkView
from shmmap.chunks.marking import Marker
from shmmap.chunks.marks import Marks
from shmmap.chunks.occupancy import Occupancy, ScanFilter, log_odds, probability
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import ConfigError, SegmentCorrupt
from tests.support.chunk_memory import ChunkMemory
from tests.support.live_drive import FILTER, SlowOccupancy, drive


def one_word(key: ChunkKey, hits: dict[int, int], misses: dict[int, int]) -> Marks:
    """Marks in one chunk, by word."""
    return Marks(
        np.array([key], np.int32), np.array([len(hits)], np.uint32), np.array([len(misses)], np.uint32),
        np.array([*hits.values(), *misses.values()], np.uint64), np.array([*hits, *misses], np.uint16),
    )  # fmt: skip


def test_a_drive_equals_the_slow_one_voxel_by_voxel() -> None:
    memory, marker = ChunkMemory(0.2), Marker(0.2, FILTER)
    slow = SlowOccupancy(0.2, min_range=0.2, max_range=9.0, min_z=-5.0, max_z=5.0)
    for number, (points, pose) in enumerate(drive(12), 1):
        memory.apply(marker.mark(points, pose)[0], scan=number)
        slow.insert(points.tolist(), pose.tolist()[:3])
    assert memory.voxels() == slow.voxels
    assert len(memory.chunks) > 20


def test_evidence_stops_at_the_clamps_and_may_come_to_nothing() -> None:
    """A miss, and hits that add up to exactly as much: unknown again."""
    memory = ChunkMemory(0.1, Occupancy(hit=1 / (1 + math.exp(-0.4055)), miss=1 / (1 + math.exp(0.4055))))
    assert memory.occupancy.steps[:2] == (405, -405)
    key, place = ChunkKey(0, 0, 0), {0: 1}
    states = []
    for number, (hits, misses) in enumerate([({}, place), (place, {}), (place, {}), *[({}, place)] * 9], 1):
        memory.apply(one_word(key, hits, misses), scan=number)
        state = memory.chunks[key].state
        states.append(
            (int(memory.chunks[key].dense()[0]), *(int(state[n]) for n in ("active", "occupied", "free")))
        )
        memory.voxels()
    assert states[:3] == [(-405, 1, 0, 1), (0, 0, 0, 0), (405, 1, 1, 0)]
    assert states[-1] == (-1992, 1, 0, 1)
    for number in range(20):
        memory.apply(one_word(key, place, {}), scan=100 + number)
    assert int(memory.chunks[key].dense()[0]) == 3476


def test_every_voxel_of_a_chunk() -> None:
    memory, key = ChunkMemory(0.1), ChunkKey(-1, -1, -1)
    everything = dict.fromkeys(range(4096), 2**64 - 1)
    memory.apply(one_word(key, everything, {}), scan=1)
    memory.apply(one_word(key, {}, everything), scan=2)
    view = memory.chunks[key]
    assert (view.dense() == 847 - 405).all()
    assert (int(view.state["bricks"]), int(view.state["occupied"])) == (1024, 64**3)


def test_thresholds_decide_what_counts() -> None:
    memory = ChunkMemory(0.1, Occupancy(occupied_above=0.8, free_below=0.3))
    key = ChunkKey(0, 0, 0)
    for number in (1, 2, 3):
        memory.apply(one_word(key, {0: 0b11}, {1: 0b111}), scan=number)
        state = memory.chunks[key].state
        counted = tuple(int(state[name]) for name in ("active", "occupied", "free"))
        assert counted == (5, 2 * (number * 847 > 1386), 3 * (number * -405 < -847))


def test_bricks_lie_in_the_order_in_which_they_were_touched() -> None:
    memory, key = ChunkMemory(0.1), ChunkKey(0, 0, 0)
    memory.apply(one_word(key, {4 * 9: 1, 4 * 700: 1}, {4 * 3: 1}), scan=1)
    memory.apply(one_word(key, {4 * 3: 1, 4 * 5: 1}, {}), scan=2)
    index = memory.chunks[key].index
    assert {brick: int(index[brick]) for brick in np.flatnonzero(index).tolist()} == {
        9: 1,
        700: 2,
        3: 3,
        5: 4,
    }


def test_a_scan_that_comes_twice_counts_once() -> None:
    memory, key = ChunkMemory(0.1), ChunkKey(0, 0, 0)
    for mapper, scan in ((1, 5), (1, 5), (1, 4), (2, 5), (2, 5), (1, 6)):
        memory.apply(one_word(key, {0: 1}, {}), mapper=mapper, scan=scan)
    state = memory.chunks[key].state
    assert int(memory.chunks[key].dense()[0]) == 3 * 847
    assert (int(state["version"]), int(state["sequence"]), int(state["changed_ns"])) == (3, 6, 6)


@pytest.mark.parametrize("period", range(1, 8))
def test_evidence_counts_whatever_number_of_scans_lies_between(period: int) -> None:
    """Bonxai passed over a voxel that it saw again after exactly three scans."""
    memory, key = ChunkMemory(0.1), ChunkKey(0, 0, 0)
    for number in range(4):
        memory.apply(one_word(key, {0: 1}, {}), scan=1 + number * period)
    assert memory.voxels() == {(0, 0, 0): 4 * 847}


def test_a_chunk_remembers_the_mappers_that_the_map_knows() -> None:
    memory, key = ChunkMemory(0.1), ChunkKey(0, 0, 0)
    all_mappers = tuple(range(1, MAPPERS + 1))
    for mapper in all_mappers:
        memory.apply(one_word(key, {0: 1}, {}), mapper=mapper, scan=1, known=all_mappers)
    with pytest.raises(SegmentCorrupt, match="32 mappers"):
        memory.apply(one_word(key, {0: 1}, {}), mapper=99, scan=1, known=(*all_mappers, 99))
    memory = ChunkMemory(0.1)
    for mapper in all_mappers:
        memory.apply(one_word(key, {0: 1}, {}), mapper=mapper, scan=1, known=all_mappers)
    known = (*all_mappers[:3], *all_mappers[4:], 99)
    memory.apply(one_word(key, {0: 1}, {}), mapper=99, scan=1, known=known)
    mappers = memory.chunks[key].state["mappers"]["number"].tolist()
    assert mappers == [1, 2, 3, 99, *range(5, MAPPERS + 1)]


class Died(BaseException):
    """Stands for SIGKILL: nothing of ours runs after it."""


def dies_at(monkeypatch: pytest.MonkeyPatch, label: str, time: int) -> None:
    left = [time]

    def step(here: str) -> None:
        left[0] -= here == label
        if left[0] == 0:
            left[0] = -1
            raise Died

    monkeypatch.setattr(applying, "step", step)


def interrupted(
    monkeypatch: pytest.MonkeyPatch, label: str, *, undo: bool
) -> tuple[ChunkMemory, ChunkMemory]:
    """The same drive twice; in one the writer dies in its seventh scan, and the mapper sends that again."""
    broken, whole, marker = ChunkMemory(0.2), ChunkMemory(0.2), Marker(0.2, FILTER)
    for number, (points, pose) in enumerate(drive(9), 1):
        marks, _ = marker.mark(points, pose)
        whole.apply(marks, scan=number)
        if number == 7:
            dies_at(monkeypatch, label, 5)
            with pytest.raises(Died):
                broken.apply(marks, scan=number)
            monkeypatch.setattr(applying, "step", lambda _label: None)
            of = broken.undo.of
            if of is not None and undo:
                before = int(broken.chunks[of[0]].state["sequence"])
                broken.undo.restore(broken.chunks[of[0]])
                after = int(broken.chunks[of[0]].state["sequence"])
                assert after % 2 == 0
                assert after > before
            assert (broken.undo.of is None) == (undo or of is None)
        broken.apply(marks, scan=number)
    return broken, whole


@pytest.mark.parametrize("label", ["live.copied", "live.odd", "live.applied", "live.even"])
def test_a_writer_that_dies_loses_nothing(monkeypatch: pytest.MonkeyPatch, label: str) -> None:
    broken, whole = interrupted(monkeypatch, label, undo=True)
    assert broken.voxels() == whole.voxels()
    for key, view in whole.chunks.items():
        other = broken.chunks[key]
        assert other.bricks.tobytes()[: view.bricks.nbytes] == view.bricks.tobytes()
        assert np.array_equal(other.index, view.index)
        assert np.array_equal(other.state["mappers"], view.state["mappers"])


def test_without_the_undo_record_something_would_be_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    broken, whole = interrupted(monkeypatch, "live.applied", undo=False)
    with pytest.raises((AssertionError, SegmentCorrupt)):
        assert broken.voxels() == whole.voxels()


def test_while_it_is_written_a_chunk_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    memory, key = ChunkMemory(0.1), ChunkKey(0, 0, 0)
    seen: dict[str, int] = {}
    monkeypatch.setattr(
        applying, "step", lambda label: seen.update({label: int(memory.chunk(key).state["sequence"])})
    )
    memory.apply(one_word(key, {0: 1}, {}), scan=1)
    assert seen == {"live.copied": 0, "live.odd": 1, "live.applied": 1, "live.even": 2}


def test_an_undo_record_of_something_else_is_refused() -> None:
    memory, key = ChunkMemory(0.1), ChunkKey(0, 0, 0)
    memory.apply(one_word(key, {4 * brick: 1 for brick in range(5)}, {}), scan=1)
    view = memory.chunks[key]
    memory.undo.keep(view, view.index[:5].copy())
    assert memory.undo.of == (key, 1)
    with pytest.raises(SegmentCorrupt, match="undo record"):
        memory.undo.restore(ChunkView(bytearray(view.data[: 4096 + 3 * 512])))


# --- what evidence is worth: Rolling-Bonxai's figures, in thousandths -------------------------------------


def test_the_defaults_are_rolling_bonxai_s() -> None:
    assert Occupancy().steps == (847, -405, -1992, 3476)
    assert Occupancy().thresholds == (0, 0)
    assert ScanFilter() == ScanFilter(min_range=0.5, max_range=5.0, min_z=-2.0, max_z=2.0)


def test_log_odds_and_back() -> None:
    assert [log_odds(p) for p in (0.5, 0.9, 0.1)] == [0, 2197, -2197]
    assert probability(0) == 0.5
    assert probability(log_odds(0.7)) == pytest.approx(0.7, abs=1e-3)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("hit", 0.5), ("hit", 0.4), ("hit", 1.0), ("hit", math.nan), ("miss", 0.5), ("miss", 0.6),
        ("miss", 0.0), ("clamp_min", 0.5), ("clamp_max", 0.5), ("clamp_max", 1.5), ("occupied_above", 0.4),
        ("occupied_above", 0.97), ("free_below", 0.6), ("free_below", 0.12), ("hit", 0.5001),
    ],
)  # fmt: skip
def test_an_occupancy_that_makes_no_sense_is_refused(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=key) as caught:
        Occupancy(**{key: value})
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("max_range", {"max_range": 0.5}), ("max_range", {"max_range": math.inf}),
        ("min_range", {"min_range": math.nan}), ("min_range", {"min_range": -1.0}), ("max_z", {"min_z": 2.0}),
    ],
)  # fmt: skip
def test_a_filter_that_lets_nothing_through_is_refused(key: str, values: dict[str, float]) -> None:
    with pytest.raises(ConfigError) as caught:
        ScanFilter(**values)
    assert caught.value.key == key


def test_rays_have_a_greatest_length() -> None:
    Marker(0.05, ScanFilter(max_range=201.0))
    with pytest.raises(ConfigError, match=r"at most 201\.6 m"):
        Marker(0.05, ScanFilter(max_range=202.0))
