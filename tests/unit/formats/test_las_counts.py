# SPDX-License-Identifier: Apache-2.0
"""What a LAS header counts against the bytes that are there: said, or refused; scales that make no place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import MapDataError
from shmmap.formats.cloud import describe, read_cloud
from tests.support.cloud_bytes import POINTS, las_file, patched


def said(path: Path) -> str:
    """Warnings of the three readers of a file, which are the same."""
    warnings = describe(path).warnings
    assert read_cloud(path).warnings == warnings
    made = divide([path], path.with_suffix(".map"), DivideSettings(durable=False, force=True))
    for warning in warnings:
        assert any(warning in note for note in made.notes)
    return " ".join(warnings)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(("version", "form"), [("1.4", 6), ("1.2", 3)])
def test_sound_files_say_nothing(tmp_path: Path, suffix: str, version: str, form: int) -> None:
    assert said(las_file(tmp_path / f"a.{suffix}", version=version, form=form)) == ""


def test_half_of_the_points_counted(tmp_path: Path) -> None:
    path = patched(las_file(tmp_path / "a.las"), 247, "Q", POINTS // 2)
    assert read_cloud(path).points == POINTS // 2
    assert f"{500 * 30} bytes after the last point ignored, room for 500 more points" in said(path)
    old = patched(las_file(tmp_path / "b.las", version="1.2", form=3), 107, "I", POINTS - 1)
    assert "34 bytes after the last point ignored, room for 1 more points" in said(old)


def test_half_of_a_compressed_chunk_counted(tmp_path: Path) -> None:
    """Chunks of point formats from 6 on count their points, be there one chunk or more."""
    path = patched(las_file(tmp_path / "a.laz"), 247, "Q", POINTS // 2)
    assert "the header counts 500 points, the compressed data 1000" in said(path)
    path = patched(las_file(tmp_path / "b.laz", points=120_000), 247, "Q", 110_000)
    assert "the header counts 110000 points, the compressed data 120000" in said(path)


def test_compressed_chunks_that_are_not_counted(tmp_path: Path) -> None:
    path = las_file(tmp_path / "a.laz", version="1.2", form=3, points=120_000)
    assert "there: the chunks behind are ignored" in said(patched(path, 107, "I", 60_000))


def test_points_of_copc_that_are_not_counted(data_dir: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.copc.laz"
    path.write_bytes((data_dir / "las_copc" / "lone-star.copc.laz").read_bytes())
    patched(path, 247, "Q", 518_862 - 5)
    assert "the header counts 518857 points, the compressed data 518862" in " ".join(describe(path).warnings)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_only_the_legacy_field(tmp_path: Path, suffix: str) -> None:
    path = las_file(tmp_path / f"a.{suffix}", form=3)
    patched(path, 247, "Q", 0)
    patched(path, 107, "I", POINTS)
    assert "only the legacy count says how many points there are, 1000" in said(path)
    cloud = read_cloud(path)
    assert (cloud.points, cloud.xyz[-1].tolist()) == (POINTS, pytest.approx([99.9] * 3))
    patched(path, 247, "Q", POINTS)
    patched(path, 107, "I", 7)
    assert "the header counts 1000 points, its legacy count 7" in said(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(
    ("change", "cause", "words"),
    [
        (lambda path: patched(path, 247, "Q", 0), "bad_las", "counts no points, but"),
        (lambda path: patched(path, 131, "d", 0.0), "bad_las", "the scale of x is 0"),
        (lambda path: patched(path, 147, "d", float("nan")), "bad_las", "the scale of z is nan"),
        (lambda path: patched(path, 163, "d", float("inf")), "bad_las", "the offset of y is inf"),
        (lambda path: patched(path, 247, "Q", 10**9), "truncated", "1000000000 points announced"),
        (lambda path: patched(path, 247, "Q", 10**18), "truncated", "points announced"),
        (lambda path: path, "", ""),
    ],
)
def test_what_contradicts_itself_is_refused(
    tmp_path: Path, suffix: str, change: Callable[[Path], Path], cause: str, words: str
) -> None:
    path = change(las_file(tmp_path / f"a.{suffix}"))
    if not cause:
        assert read_cloud(path).points == POINTS
        return
    for read in (read_cloud, describe):
        with pytest.raises(MapDataError) as caught:
            read(path)
        assert (caught.value.cause, words in str(caught.value)) == (cause, True), str(caught.value)
        assert caught.value.offset is not None
    with pytest.raises(MapDataError):
        divide([path], tmp_path / "map", DivideSettings(durable=False))


@pytest.mark.parametrize("bounds", [(0.0, 0.0), (float("nan"), float("nan")), (-5.0, 5.0)])
def test_bounds_that_could_not_be_true_are_not_believed(tmp_path: Path, bounds: tuple[float, float]) -> None:
    """A writer that leaves them out: float32 would have lost half a metre, and nothing said so."""
    path = las_file(tmp_path / "a.las")
    patched(path, 155, "3d", 5e6, 5e6, 0.0)
    patched(path, 179, "6d", *bounds * 3)
    made = divide([path], tmp_path / "map", DivideSettings(durable=False, check=True))
    assert made.bounds is not None
    assert np.array(made.bounds[1]) + made.origin == pytest.approx([5e6 + 99.9, 5e6 + 99.9, 99.9], abs=1e-3)


@pytest.mark.parametrize("at", [94, 96, 100, 235, 243])
def test_records_that_are_not_there(tmp_path: Path, at: int) -> None:
    """Any value of what says where records are: read, warned of, or refused; never a crash or a hang."""
    original = las_file(tmp_path / "o.las").read_bytes()
    for value in (0, 1, 0xFFFF, 0x7FFFFFFF):
        path = tmp_path / "a.las"
        path.write_bytes(original)
        patched(path, at, "H" if at == 94 else "I", value & (0xFFFF if at == 94 else 0xFFFFFFFF))
        try:
            points = read_cloud(path).points
        except MapDataError as error:
            points = POINTS if error.cause in ("bad_las", "truncated") else -1
        assert points == POINTS
