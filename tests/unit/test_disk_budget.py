# SPDX-License-Identifier: Apache-2.0
"""The budget of a cache directory: what goes first, what is never touched, when it is looked at."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from shmmap.disk_budget import DiskBudget, mark_used
from tests.support.interleaving import interleaved

PLACES = {"layer": "layers/version/ab", "cell": "objects/cells/ab", "page": "objects/index/ab"}
HOUR_S = 3600.0
BLOCK = 4096


class Directory:
    """A cache directory with files of some sizes and ages."""

    def __init__(self, path: Path) -> None:
        self.path = path
        (path / "objects").mkdir(mode=0o700, parents=True)

    def add(self, kind: str, number: int, nbytes: int = BLOCK, used_s: float | None = None) -> Path:
        folder = self.path / PLACES[kind]
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / (f"{number}.layer" if kind == "layer" else f"{number:064x}")
        file.write_bytes(bytes(nbytes))
        os.utime(file, (0, number if used_s is None else used_s))
        return file

    def left(self) -> set[str]:
        return {
            f"{kind} {int(file.stem, 16)}"
            for kind, at in PLACES.items()
            for file in (self.path / at).glob("*")
        }


@pytest.fixture
def here(tmp_path: Path) -> Directory:
    return Directory(tmp_path / "cache")


def test_layers_and_objects_are_one_order_and_pages_go_last(here: Directory) -> None:
    kinds = ["page", *["layer", "cell"] * 5, "page"]
    for number, kind in enumerate(kinds):
        here.add(kind, number)
    budget = DiskBudget(str(here.path), 12 * BLOCK)
    assert budget.trim() == budget.used_bytes() == 12 * BLOCK, "there is room"
    assert DiskBudget(str(here.path), 11 * BLOCK).trim() == 10 * BLOCK
    assert here.left() == {f"{kind} {n}" for n, kind in enumerate(kinds)} - {"layer 1", "cell 2"}


def test_pages_go_last_only_up_to_a_quarter_of_the_budget(here: Directory) -> None:
    for number in range(8):
        here.add("page", number)
    for number in range(8, 12):
        here.add("cell", number)
    assert DiskBudget(str(here.path), 8 * BLOCK).trim() == 7 * BLOCK
    assert here.left() == {"page 5", "page 6", "page 7"} | {f"cell {n}" for n in range(8, 12)}
    assert DiskBudget(str(here.path), 4 * BLOCK).trim() == 3 * BLOCK
    assert here.left() == {"page 7", "cell 10", "cell 11"}
    assert DiskBudget(str(here.path), 0).trim() == 0
    assert here.left() == set()


def test_small_files_count_what_they_take_on_the_disk(here: Directory) -> None:
    for number in range(8):
        here.add("cell", number, nbytes=100)
    on_disk = sum(file.stat().st_blocks * 512 for file in here.path.rglob("*") if file.is_file())
    assert on_disk > 8 * 100
    budget = DiskBudget(str(here.path), on_disk)
    assert budget.used_bytes() == on_disk
    assert DiskBudget(str(here.path), on_disk // 2).trim() <= on_disk // 2
    assert 0 < len(here.left()) <= 4
    of_small = DiskBudget(str(here.path), 256 * BLOCK)
    assert [of_small.added(1) for _ in range(5)] == [False] * 4 + [True]


def test_files_that_are_added_at_the_same_time_all_count(here: Directory) -> None:
    def add(budget: DiskBudget) -> None:
        assert not budget.added(2 * BLOCK)

    for budget in interleaved(lambda: DiskBudget(str(here.path), 256 * BLOCK), add, add):
        assert budget.added(1), "now it is more than 1/64 of the budget"


def test_both_names_of_a_layer_are_one_file(here: Directory) -> None:
    file = here.add("layer", 1)
    other = here.path / "layers/content/ab/2.layer"
    other.parent.mkdir(parents=True)
    other.hardlink_to(file)
    here.add("cell", 2)
    assert DiskBudget(str(here.path), 2 * BLOCK).trim() == 2 * BLOCK
    assert DiskBudget(str(here.path), 2 * BLOCK - 1).trim() == BLOCK
    assert not file.exists()
    assert not other.exists()
    assert here.left() == {"cell 2"}


def test_other_files_are_never_touched(here: Directory, tmp_path: Path) -> None:
    outside = Directory(tmp_path / "outside")
    kept = [outside.add(kind, 1) for kind in PLACES]
    strange = [here.path / name for name in ("layers/notes.txt", "objects/cells/README", "a.catalogue")]
    (here.path / "layers").mkdir()
    (here.path / "objects/cells").mkdir()
    for file in strange:
        file.write_bytes(bytes(1000))
    (here.path / "layers/elsewhere").symlink_to(outside.path / "layers")
    (here.path / "objects/cells/ab").symlink_to(outside.path / "objects/cells/ab")
    (here.path / "objects/index").symlink_to(outside.path / "objects/index")
    assert DiskBudget(str(here.path), 0).trim() == 0
    assert all(file.exists() for file in kept + strange)


@pytest.mark.parametrize("name", ["layers", "objects"])
def test_a_place_that_is_a_link_a_pipe_or_a_file_is_no_place(tmp_path: Path, name: str) -> None:
    outside = Directory(tmp_path / "outside")
    kept = [outside.add(kind, 1) for kind in PLACES]
    place = tmp_path / "cache" / name
    place.parent.mkdir()
    makers: list[Callable[[], object]] = [
        lambda: place.symlink_to(outside.path / name),
        lambda: os.mkfifo(place),
        lambda: place.touch(),
    ]
    for make in makers:
        make()
        assert DiskBudget(str(place.parent), 0).trim() == 0
        place.unlink()
    assert all(file.exists() for file in kept)


def test_a_cache_that_is_not_there_is_empty(tmp_path: Path) -> None:
    assert DiskBudget(str(tmp_path / "none"), 1000).trim() == 0
    with pytest.raises(FileNotFoundError):
        DiskBudget(str(tmp_path / "none"), 1000).has_room(1)


def test_objects_that_others_may_write_do_not_count(here: Directory) -> None:
    file = here.add("cell", 1)
    (here.path / "objects").chmod(0o770)
    assert DiskBudget(str(here.path), 0).trim() == 0
    assert file.exists()


def test_what_was_left_half_written_goes_an_hour_later(here: Directory) -> None:
    here.add("cell", 1)
    now_s = time.time()
    ages = {"young": now_s, "old": now_s - 1.1 * HOUR_S, "of tomorrow": now_s + 24 * HOUR_S}
    for name, used_s in ages.items():
        for place in PLACES.values():
            file = here.path / place / f".new-{name}"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(b"half")
            os.utime(file, (0, used_s))
    DiskBudget(str(here.path), 1000).trim()
    left = {file.name for place in PLACES.values() for file in (here.path / place).glob(".new-*")}
    assert left == {".new-young"}


def test_a_process_that_adds_looks_before_there_is_much_too_much(here: Directory) -> None:
    """Four processes at a time, files of any size: never more than the budget and a sixteenth of it."""
    limit, random_ = 1_000_000, random.Random(3)
    budgets = [DiskBudget(str(here.path), limit) for _ in range(4)]
    for number in range(1500):
        nbytes = random_.randrange(1, 4000)
        here.add("cell", number, nbytes)
        budget = budgets[random_.randrange(4)]
        if budget.added(nbytes):
            budget.trim()
        if number % 10 == 0:
            assert budgets[0].used_bytes() <= limit * 17 / 16
    assert budgets[0].used_bytes() > limit * 14 / 16
    assert f"cell {number}" in here.left()


def test_room_is_left_for_others(here: Directory) -> None:
    budget = DiskBudget(str(here.path), 1 << 40)
    real = os.statvfs(here.path)
    assert budget.has_room(1)
    assert not budget.has_room(real.f_bavail * real.f_frsize)
    budget.limit_bytes = 10
    assert budget.has_room(10)
    assert not budget.has_room(11)


def test_use_is_noted_now_and_then_whatever_the_clock_said(here: Directory) -> None:
    now_s = time.time()
    for used_s, noted in ((now_s - 60, False), (now_s - HOUR_S, True), (now_s + 24 * HOUR_S, True)):
        file = here.add("cell", 1, used_s=used_s)
        with file.open("rb") as opened:
            mark_used(opened.fileno(), os.fstat(opened.fileno()))
        assert (abs(file.stat().st_mtime - used_s) > 1) is noted
        assert not noted or abs(file.stat().st_mtime - now_s) < 60
