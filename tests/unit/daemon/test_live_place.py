# SPDX-License-Identifier: Apache-2.0
"""Where live maps go, and what they may take: never on huge pages, never more than there is."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmmap.daemon import map_in_memory
from shmmap.daemon.host.memory import choose_budget, room_bytes
from shmmap.daemon.map_in_memory import CEILING_BYTES, CELLS_WITHOUT_MAP, place_live_maps, share_of_live_maps
from shmmap.errors import CannotStart, ConfigError
from shmmap.live_messages import Begin
from shmmap.live_settings import LiveSettings
from shmmap.mounts import Mount
from shmmap.segment.directory import ShmDirectory

MIB = 1 << 20
SIZE, FREE = 8192 * MIB, 4096 * MIB


@pytest.fixture
def cells(monkeypatch: pytest.MonkeyPatch) -> Iterator[ShmDirectory]:
    """A directory on a tmpfs of 8 GiB, of which half is free."""
    monkeypatch.setattr(ShmDirectory, "size_bytes", lambda _self: SIZE)
    monkeypatch.setattr(ShmDirectory, "free_bytes", lambda _self: FREE)
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        one = ShmDirectory(path)
        yield one
        one.close()


def placed(
    cells: ShmDirectory,
    *maps: str,
    cells_budget: int = 0,
    shm_dir: str = "",
    budget: int = 0,
    share: int = FREE // 8,
) -> Begin:
    return place_live_maps(
        [LiveSettings(name, f"/srv/{name}") for name in maps or ("lidar",)], instance="city", cells=cells,
        cells_budget_bytes=cells_budget, share_bytes=share, shm_dir=shm_dir, budget_bytes=budget, gid=5,
        marks_gid=6,
    )  # fmt: skip


def mounted(monkeypatch: pytest.MonkeyPatch, *rows: tuple[str, str]) -> None:
    """Have the machine's mounts be these: where, and the options of the file system."""
    found = [Mount("tmpfs", "/", point, options.split(",")) for point, options in rows]
    monkeypatch.setattr("shmmap.mounts.mounts", lambda _root: iter(found))


def test_beside_the_cells(cells: ShmDirectory) -> None:
    begin = placed(cells)
    assert begin.shm_dir == cells.path
    assert begin.marks_dir == f"{cells.path}/shmmap-live.city.marks"
    assert begin.budget_bytes == FREE // 8
    assert (begin.gid, begin.marks_gid, begin.maps[0].path) == (5, 6, "/srv/lidar")


def test_a_map_without_a_directory_gets_one(cells: ShmDirectory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_in_memory, "live_directory", lambda instance, name: f"/state/{instance}/{name}")
    begin = place_live_maps(
        [LiveSettings("lidar")], instance="city", cells=cells, cells_budget_bytes=0, share_bytes=0,
        shm_dir="", budget_bytes=0, gid=-1, marks_gid=-1,
    )  # fmt: skip
    assert begin.maps[0].path == "/state/city/lidar"


def test_what_an_previous_run_left_counts_as_free(
    cells: ShmDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ShmDirectory, "free_bytes", lambda _self: 0)
    (Path(cells.path) / "shmmap-live.city.lidar.0_0_0.5").write_bytes(bytes(64 * MIB))
    (Path(cells.path) / "shmmap-live.town.lidar.0_0_0.5").write_bytes(bytes(64 * MIB))
    assert placed(cells).budget_bytes == 64 * MIB
    assert placed(cells, budget=60 * MIB).budget_bytes == 60 * MIB
    with pytest.raises(CannotStart, match=r"of 65 MiB do not fit .* 64 MiB free"):
        placed(cells, budget=65 * MIB)


def test_both_budgets_fit_in_the_file_system(cells: ShmDirectory) -> None:
    assert placed(cells, budget=FREE, cells_budget=SIZE - FREE).budget_bytes == FREE
    with pytest.raises(ConfigError, match="of 4,096 MiB and cells of 4,097 MiB do not fit") as caught:
        placed(cells, budget=FREE, cells_budget=SIZE - FREE + MIB)
    assert caught.value.key == "live_budget"
    assert "lower --live-budget or --budget" in caught.value.hint
    with pytest.raises(CannotStart, match="4,096 MiB free") as no_room:
        placed(cells, budget=FREE + MIB)
    assert "free some" in no_room.value.hint


def test_each_map_gets_a_few_chunks(cells: ShmDirectory, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [f"m{number}" for number in range(5)]
    assert placed(cells, *names, budget=20 * MIB).budget_bytes == 20 * MIB
    with pytest.raises(ConfigError, match="5 live maps share 19 MiB; each needs 4") as caught:
        placed(cells, *names, budget=19 * MIB)
    assert "20M at least" in caught.value.hint
    assert placed(cells, *names, share=0).budget_bytes == 20 * MIB


@pytest.mark.parametrize(
    ("options", "huge"),
    [
        ("rw", False), ("rw,huge=never", False), ("rw,huge=advise", False), ("rw,huge=always", True),
        ("rw,huge=within_size,size=4G", True),
    ],
)  # fmt: skip
def test_a_directory_with_huge_pages_is_not_used(
    cells: ShmDirectory, monkeypatch: pytest.MonkeyPatch, options: str, huge: bool
) -> None:
    mounted(monkeypatch, ("/", "rw"), ("/dev/shm", "rw"), (cells.path, options))
    assert placed(cells).shm_dir == ("/dev/shm" if huge else cells.path)
    if huge:
        with pytest.raises(ConfigError, match="has huge pages") as caught:
            placed(cells, shm_dir=cells.path)
        assert caught.value.key == "live_shm_dir"
        assert "without them" in caught.value.hint


def test_the_innermost_and_last_mount_counts(cells: ShmDirectory, monkeypatch: pytest.MonkeyPatch) -> None:
    below = os.path.join(cells.path, "below")
    os.mkdir(below)
    mounted(monkeypatch, (cells.path, "huge=always"), ("/dev/shm", "rw"), (below, "rw"))
    assert placed(cells, shm_dir=below).shm_dir == below
    mounted(monkeypatch, (cells.path, "huge=always"), (cells.path, "rw"))
    assert placed(cells).shm_dir == cells.path
    mounted(monkeypatch, (cells.path[:-1], "huge=always"), ("/", "rw"))
    assert placed(cells).shm_dir == cells.path, "a name that begins like it is another directory"
    mounted(monkeypatch)
    assert placed(cells).shm_dir == cells.path
    os.rmdir(below)


Budgets = Callable[..., tuple[int, int]]


@pytest.fixture
def budgets(cells: ShmDirectory, monkeypatch: pytest.MonkeyPatch) -> Budgets:
    """Budgets of cells and of live maps, as `MapInMemory` and the daemon's start choose them."""

    def chosen(
        size: int, maps: int, *, cells_asked: int = 0, live_asked: int = 0, points: bool = True
    ) -> tuple[int, int]:
        monkeypatch.setattr(ShmDirectory, "size_bytes", lambda _self: size)
        monkeypatch.setattr(ShmDirectory, "free_bytes", lambda _self: size)
        monkeypatch.setattr("shmmap.daemon.host.memory._memory_bytes", lambda _which: 16 << 30)
        share = share_of_live_maps(
            maps, cells=cells, room=room_bytes(cells), shm_dir="", budget_bytes=live_asked, alone=not points
        )  # fmt: skip
        asked = cells_asked or (0 if points else CELLS_WITHOUT_MAP)
        of_cells = choose_budget(asked, cells, beside_bytes=share)
        if not maps:
            return of_cells, 0
        names = [f"m{number}" for number in range(maps)]
        begin = placed(cells, *names, cells_budget=of_cells, budget=live_asked, share=share)
        return of_cells, begin.budget_bytes

    return chosen


@pytest.mark.parametrize("size", [64 * MIB, 128 * MIB, 256 * MIB, 512 * MIB, 1024 * MIB, 2048 * MIB])
def test_what_is_not_served_gets_nothing(
    budgets: Budgets, size: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Points alone, live maps alone, both: nine tenths of a small tmpfs are used, and no part is a crumb."""
    of_cells, none = budgets(size, 0)
    assert (of_cells, none) == (size - size // 20, 0)
    statistics, of_live = budgets(size, 1, points=False)
    assert statistics == CELLS_WITHOUT_MAP
    assert of_live == min(size - size // 20 - CELLS_WITHOUT_MAP, CEILING_BYTES)
    caplog.clear()
    both = budgets(size, 1)
    assert both[1] == max(4 * MIB, (size - size // 20) // 8)
    assert sum(both) == size - size // 20
    few = "live maps get little memory" in caplog.text
    assert few == (both[1] < 16 * MIB), "with the remedy"
    assert ("live_budget" in caplog.text) == few


@pytest.mark.parametrize(
    ("maps", "cells_asked", "live_asked", "of_live"),
    [
        (1, 0, 0, 7), (3, 0, 0, 12), (1, 0, 32, 32), (1, 40, 0, 7), (1, 40, 16, 16), (1, 58, 0, 6),
        (1, 62, 0, None), (1, 40, 32, None), (16, 0, 0, None), (1, 0, 63, None),
    ],
)  # fmt: skip
def test_a_small_shm_is_shared_by_default_and_refused_where_it_was_set(
    budgets: Budgets, maps: int, cells_asked: int, live_asked: int, of_live: int | None
) -> None:
    """Docker's /dev/shm has 64 MiB: the default budgets make room for each other."""
    asked = {"cells_asked": cells_asked * MIB, "live_asked": live_asked * MIB}
    if of_live is None:
        with pytest.raises((ConfigError, CannotStart)):
            budgets(64 * MIB, maps, **asked)
        return
    of_cells, found = budgets(64 * MIB, maps, **asked)
    assert of_cells + found <= 64 * MIB
    assert of_cells == (asked["cells_asked"] or of_cells)
    assert found // MIB == of_live


def test_a_directory_of_its_own(cells: ShmDirectory) -> None:
    with pytest.raises(CannotStart, match="shared-memory directory /nothing/here"):
        placed(cells, shm_dir="/nothing/here")
