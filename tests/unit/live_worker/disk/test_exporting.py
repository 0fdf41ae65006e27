# SPDX-License-Identifier: Apache-2.0
"""What is exported are the voxels of the saved chunks, each at its place, whatever the format."""

from __future__ import annotations

import re
from contextlib import closing
from pathlib import Path

import numpy as np
import plyfile
import pytest
from numpy.typing import NDArray

from shmmap.chunks.occupancy import Occupancy, probability
from shmmap.dividing.frame import Translation
from shmmap.errors import MapDataError
from shmmap.formats.cloud import read_cloud
from shmmap.live_worker.disk.exporting import ExportedVoxels, Format, Voxels, export
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.map_record import MapSettings
from shmmap.live_worker.disk.stored_map import StoredMap, opened_map
from tests.support.divided_map import read_pcd
from tests.support.live_drive import RESOLUTION, SETTINGS, Voxel
from tests.support.live_reference import contents, stored_drive
from tests.support.stored_chunks import change_chunk, largest

FORMATS: list[Format] = ["ply", "pcd", "map"]
FAR = (52000.0, -41000.0, 0.0)
"""Where float32 would lose millimetres."""


def exported(
    directory: Path,
    kind: Format,
    voxels: Voxels = "occupied",
    *,
    translate: Translation = "auto",
    force: bool = False,
) -> ExportedVoxels | None:
    with opened_map(str(directory)) as stored:
        return export(
            stored, place(directory, kind), kind, voxels=voxels,
            translate=translate, force=force,
        )  # fmt: skip


def place(directory: Path, kind: Format) -> Path:
    return directory.parent / "made" / f"out.{kind}"


def columns_of(made: ExportedVoxels) -> dict[str, NDArray[np.floating]]:
    """All points, wherever they are."""
    if made.format == "ply":
        rows = plyfile.PlyData.read(made.path)["vertex"].data
        return {name: rows[name] for name in rows.dtype.names}
    if made.format == "pcd":
        return read_pcd(Path(made.path))
    cells = [read_pcd(path) for path in sorted(Path(made.path).rglob("*.pcd")) if path.is_file()]
    assert len(cells) == made.cells > 3
    return {name: np.concatenate([cell[name] for cell in cells]) for name in cells[0]}


def assert_are(made: ExportedVoxels | None, voxels: dict[Voxel, int]) -> None:
    """Every voxel is there once, its point in its middle, with its probability."""
    assert made is not None
    columns = columns_of(made)
    assert list(columns) == ["x", "y", "z", "intensity"]
    assert [(name, values.dtype.str) for name, values in columns.items()] == made.fields
    assert made.voxels == len(columns["x"]) == len(voxels) > 100
    inexact = 0.0005 if columns["x"].dtype == np.float32 else 1e-9
    middles = np.column_stack([columns[axis].astype(np.float64) for axis in "xyz"]) + made.origin
    indices = np.floor(middles / RESOLUTION).astype(int)
    assert np.abs(middles - (indices + 0.5) * RESOLUTION).max() < inexact
    found = {
        (x, y, z): intensity
        for (x, y, z), intensity in zip(indices.tolist(), columns["intensity"].tolist(), strict=True)
    }
    assert found.keys() == voxels.keys()
    for voxel, value in voxels.items():
        assert found[voxel] == pytest.approx(probability(value), abs=1e-6)


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    return tmp_path / "live" / "lidar"


@pytest.mark.parametrize("kind", FORMATS)
def test_there_and_back(directory: Path, kind: Format) -> None:
    voxels = stored_drive(directory)
    before = contents(directory)
    occupied = {voxel: value for voxel, value in voxels.items() if value > 0}
    free = {voxel: value for voxel, value in voxels.items() if value < 0}
    assert all(min(part) < 0 < max(part) for part in zip(*occupied, strict=True))
    folder = Folder(directory)  # a daemon works with it
    made = exported(directory, kind)
    assert made is not None
    assert made.origin == (0.0, 0.0, 0.0)
    assert dict(made.fields)["x"] == "<f4"
    assert (made.resolution, made.frame_id, made.format) == (0.2, "map", kind)
    assert made.chunks == len({tuple(part >> 6 for part in voxel) for voxel in occupied})
    assert_are(made, occupied)
    if kind == "ply":
        cloud = read_cloud(made.path)
        assert cloud.warnings == ()
        columns = columns_of(made)
        assert np.array_equal(cloud.xyz, np.column_stack([columns[axis] for axis in "xyz"]))
        assert np.array_equal(cloud.columns["intensity"], columns["intensity"])
    assert_are(exported(directory, kind, "free", force=True), free)
    assert_are(exported(directory, kind, "both", force=True), voxels)
    assert contents(directory) == before
    folder.close()
    assert [path.name for path in place(directory, kind).parent.iterdir()] == [f"out.{kind}"]


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize(
    ("translate", "axis", "moved"),
    [("auto", "<f4", True), ("none", "<f8", False), ((-52000.0, 41000.0, 8.0), "<f4", True)],
)
def test_far_from_the_origin(
    directory: Path, kind: Format, translate: Translation, axis: str, moved: bool
) -> None:
    voxels = {voxel: value for voxel, value in stored_drive(directory, shift=FAR).items() if value > 0}
    made = exported(directory, kind, translate=translate)
    assert made is not None
    assert dict(made.fields)["x"] == axis
    assert any(made.origin) == moved
    if isinstance(translate, tuple):
        assert made.origin == (52000.0, -41000.0, -8.0)
    if kind == "ply":
        head = Path(made.path).read_bytes().partition(b"end_header")[0].decode()
        (text,) = re.findall(r"^comment voxels of 0\.2\d* m, origin (.*?) *$", head, re.M)
        assert tuple(map(float, text.split())) == made.origin
    assert_are(made, voxels)


def test_voxels_that_are_neither(directory: Path) -> None:
    """With thresholds apart from a half some voxels are known, and neither occupied nor free."""
    settings = MapSettings(RESOLUTION, Occupancy(occupied_above=0.65, free_below=0.35))
    voxels = stored_drive(directory, settings=settings)
    high, low = settings.occupancy.thresholds
    sure = {voxel: value for voxel, value in voxels.items() if value > high or value < low}
    assert 100 < len(sure) < len(voxels)
    assert any(0 < value <= high for value in voxels.values())
    assert any(low <= value < 0 for value in voxels.values())
    assert_are(exported(directory, "pcd", "both"), sure)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_damaged_chunk_ends_it(directory: Path, kind: Format) -> None:
    stored_drive(directory, 2)
    key = largest(directory)
    change_chunk(directory, key, lambda data: data[:-1])
    with pytest.raises(MapDataError, match=f"chunk {key.text}") as caught:
        exported(directory, kind, "both")
    assert "live fsck" in caught.value.hint
    assert contents(directory.parent.parent).keys() == {f"live/lidar/{name}" for name in contents(directory)}
    with closing(Folder(directory)) as folder, closing(MapDatabase(folder, SETTINGS)) as database:
        assert database.load(key) is None  # as a daemon that finds it
    made = exported(directory, kind, "both")
    assert made is not None
    assert made.lost == [key.text]


def test_one_chunk_at_a_time(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No chunk is read before the last one was released."""
    import gc
    import weakref

    stored_drive(directory)
    alive: list[weakref.ref[object]] = []
    read = StoredMap.chunk
    most = 0

    def counted(self: StoredMap, key: object) -> object:
        nonlocal most
        gc.collect()
        most = max(most, sum(one() is not None for one in alive))
        view = read(self, key)  # type: ignore[arg-type]
        alive.append(weakref.ref(view))
        return view

    monkeypatch.setattr(StoredMap, "chunk", counted)
    assert exported(directory, "ply", "both") is not None
    assert len(alive) > 5
    assert most <= 1
