# SPDX-License-Identifier: Apache-2.0
"""What cannot be divided, or not into that place: nothing appears, and nothing is lost."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.merge import merge
from shmmap.errors import BadRequest, CannotWrite, MapDataError, MapMissing
from shmmap.progress import NoProgress
from tests.support.clouds import cloud_file, divide_quickly, expected_rows, map_rows, rows_of, xyzircaedt


def test_a_large_file_of_nothing_is_refused_at_once(tmp_path: Path) -> None:
    with (tmp_path / "in.xyz").open("wb") as file:
        file.truncate(2 << 30)
    with pytest.raises(MapDataError, match="no row of numbers within 65536 bytes"):
        divide_quickly([tmp_path / "in.xyz"], tmp_path / "map")
    assert os.listdir(tmp_path) == ["in.xyz"]


def test_a_full_disk_is_foreseen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = cloud_file(tmp_path / "in.pcd", xyzircaedt(1000))
    real = os.statvfs(tmp_path)
    monkeypatch.setattr(os, "statvfs", lambda _: os.statvfs_result((*real[:3], 2, 2, *real[5:])))
    with pytest.raises(CannotWrite, match="are free"):
        divide_quickly([file], tmp_path / "map")
    assert os.listdir(tmp_path) == ["in.pcd"]


@pytest.mark.parametrize(
    ("name", "data", "error", "cause"),
    [
        ("in.las", b"LASF" + bytes(300), MapDataError, ""),
        ("in.las", b"LASF", MapDataError, "truncated"),
        ("in.pcd", b"", MapDataError, "empty_file"),
        ("in.ply", b"ply\nformat ascii 1.0\n", MapDataError, "truncated"),
        ("in.obj", b"v 1 2 3", MapDataError, "unsupported_format"),
        (None, b"", MapMissing, ""),
    ],
)
def test_bad_inputs_leave_nothing(
    tmp_path: Path, name: str | None, data: bytes, error: type[Exception], cause: str
) -> None:
    good = cloud_file(tmp_path / "good.pcd", xyzircaedt(10))
    path = tmp_path / (name or "gone.pcd")
    if name is not None:
        path.write_bytes(data)
    before = sorted(os.listdir(tmp_path))
    with pytest.raises(error) as caught:
        divide_quickly([good, path], tmp_path / "map")
    assert getattr(caught.value, "cause", cause) == cause or not cause
    assert sorted(os.listdir(tmp_path)) == before


def test_an_input_that_is_not_there_says_what_could_be_named(tmp_path: Path) -> None:
    for name in ("gone.pcd", "gone"):
        with pytest.raises(MapMissing, match=f"{name}: No such file") as caught:
            divide_quickly([tmp_path / name], tmp_path / "map")
        assert caught.value.hint.startswith("name clouds (.pcd, .las, ")


@pytest.mark.parametrize("settings", [{}, {"leaf": 0.5}, {"encoding": "ascii"}])
def test_a_run_that_fails_leaves_no_file_open(tmp_path: Path, settings: dict[str, Any]) -> None:
    good = cloud_file(tmp_path / "good.pcd", xyzircaedt(20_000, reach=90.0))
    bad = cloud_file(tmp_path / "bad.pcd", xyzircaedt(20_000, reach=90.0), "ascii")
    bad.write_bytes(bad.read_bytes()[:-100] + b"x" * 100)
    before = os.listdir("/proc/self/fd")
    with pytest.raises(MapDataError):
        divide_quickly([good, bad], tmp_path / "map", **settings)
    assert len(os.listdir("/proc/self/fd")) == len(before)


class RewrittenMeanwhile(NoProgress):
    """Replaces a file by one of as many points when a stage begins."""

    def __init__(self, file: Path, stage: str) -> None:
        self._file, self._stage = file, stage

    def stage(self, name: str, total: int) -> None:
        del total
        if name == self._stage:
            cloud_file(self._file, {key: column[::-1] for key, column in xyzircaedt(500).items()})


@pytest.mark.parametrize("number", [0, 1])
def test_an_input_that_changes_while_it_is_read_is_refused(tmp_path: Path, number: int) -> None:
    files = [cloud_file(tmp_path / f"{n}.pcd", xyzircaedt(500)) for n in range(2)]
    there = sorted(os.listdir(tmp_path))
    with pytest.raises(MapDataError, match=f"{number}.pcd: the file changed"):
        divide(files, tmp_path / "map", progress=RewrittenMeanwhile(files[number], "dividing"))
    with pytest.raises(MapDataError, match=f"{number}.pcd: the file changed"):
        merge(files, tmp_path / "out.pcd", progress=RewrittenMeanwhile(files[number], "merging"))
    assert sorted(os.listdir(tmp_path)) == there


def test_a_directory_that_cannot_be_listed_is_not_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in" / "deep").mkdir(parents=True)
    cloud_file(tmp_path / "in" / "a.pcd", xyzircaedt(10))
    scandir = os.scandir

    def refuse(path: str) -> Any:
        if path.endswith("deep"):
            raise PermissionError(13, "Permission denied", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)  # root may list everything
    with pytest.raises(MapMissing, match=r"in/deep: Permission denied"):
        divide_quickly([tmp_path / "in"], tmp_path / "map")


def test_a_file_cut_short_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    file = cloud_file(tmp_path / "in.pcd", xyzircaedt(1000))
    os.truncate(file, file.stat().st_size - 1)
    with pytest.raises(MapDataError) as caught:
        divide_quickly([file], tmp_path / "map")
    assert caught.value.cause == "truncated"
    assert os.listdir(tmp_path) == ["in.pcd"]


def test_an_empty_directory_and_settings_that_make_no_sense(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapMissing, match="no cloud"):
        divide_quickly([tmp_path / "empty"], tmp_path / "map")
    for options in (
        {"cell_size": 0.0}, {"leaf": -1.0}, {"leaf": 30.0}, {"prefix": "a/b"}, {"encoding": "zip"},
        {"memory_bytes": 1 << 20}, {"translate": (0.0, float("nan"), 0.0)},
        {"translate": (1 / 3, 0.0, 0.0)}, {"prefix": ".hidden"},
    ):  # fmt: skip
        with pytest.raises(BadRequest):  # before any file is looked at
            divide_quickly([tmp_path / "gone.pcd"], tmp_path / "map", **options)
    with pytest.raises(BadRequest, match="leaf must be a positive"):
        divide_quickly([tmp_path / "gone.pcd"], tmp_path / "map", leaf=-1.0)
    with pytest.raises(BadRequest, match="nothing"):
        divide_quickly([], tmp_path / "map")
    assert os.listdir(tmp_path) == ["empty"]


def test_a_map_is_replaced_only_by_force_and_only_a_map(tmp_path: Path) -> None:
    first, second = xyzircaedt(100), xyzircaedt(150, seed=5)
    files = [cloud_file(tmp_path / f"{i}.pcd", columns) for i, columns in enumerate((first, second))]
    out = tmp_path / "map"
    out.mkdir()
    divide_quickly(files[:1], out)  # an empty directory is filled
    with pytest.raises(BadRequest, match="is a map already") as caught:
        divide_quickly(files[1:], out)
    assert "--force" in caught.value.hint
    assert map_rows(out) == expected_rows(rows_of(first))
    divide_quickly(files[1:], out, force=True)
    assert map_rows(out) == expected_rows(rows_of(second))
    (out / "notes.txt").write_text("mine")
    with pytest.raises(BadRequest, match="not a divided map"):
        divide_quickly(files[:1], out, force=True)
    link = tmp_path / "link"
    link.symlink_to(out)
    for odd in (link, files[0]):
        with pytest.raises(BadRequest):
            divide_quickly(files[1:], odd, force=True)
    assert (out / "notes.txt").read_text() == "mine"
    assert map_rows(out) == expected_rows(rows_of(second))
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def test_inputs_and_output_apart(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    file = cloud_file(tmp_path / "in" / "a.pcd", xyzircaedt(100))
    with pytest.raises(BadRequest, match="inside the input"):
        divide_quickly([tmp_path / "in"], tmp_path / "in" / "map")
    with pytest.raises(BadRequest, match="inside the input"):
        divide_quickly([tmp_path / "in"], tmp_path / "in")
    divide_quickly([file], tmp_path / "map")
    cell = next((tmp_path / "map" / "pointcloud_map.pcd").iterdir())
    with pytest.raises(BadRequest, match="inside the output"):
        divide_quickly([cell], tmp_path / "map", force=True)
    divide_quickly([file], tmp_path / "in" / "beside")  # a file's own directory is no input
    assert sorted(os.listdir(tmp_path)) == ["in", "map"]


def test_the_parent_is_no_directory(tmp_path: Path) -> None:
    file = cloud_file(tmp_path / "in.pcd", xyzircaedt(10))
    with pytest.raises(CannotWrite):
        divide_quickly([file], file / "map")
