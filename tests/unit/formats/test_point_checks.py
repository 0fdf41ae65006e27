# SPDX-License-Identifier: Apache-2.0
"""Points that LAS marks as not to be used, and columns that are not what they are taken for."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.cli.entry import main
from shmmap.dividing.divide import divide
from shmmap.dividing.served_cloud import find_origin
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.cloud import describe, read_cloud
from shmmap.formats.pcd.writer import write_pcd
from shmmap.progress import NoProgress

POINTS = 1000
SETTINGS = DivideSettings(durable=False, force=True)


def marked(path: Path, form: int, version: str) -> Path:
    """1000 points: 20 withheld at 3000 m, 5 and 6 of noise at 2000 m (one of them withheld), 7 synthetic."""
    header = laspy.LasHeader(point_format=form, version=version)
    header.scales = np.full(3, 0.01)
    las = laspy.LasData(header)
    las.x = las.y = np.arange(POINTS) * 0.01
    z = np.zeros(POINTS)
    withheld, classes = np.zeros(POINTS, np.uint8), np.full(POINTS, 2, np.uint8)
    withheld[100:120], z[100:120] = 1, 3000.0
    classes[200:205], classes[300:306], z[200:205], z[300:306] = 7, 18, 2000.0, 2000.0
    classes[100] = 7
    las.z, las.withheld, las.classification = z, withheld, classes
    las.synthetic = np.arange(POINTS) >= POINTS - 7
    las.key_point = np.arange(POINTS) < 9
    if form >= 6:
        las.overlap = np.arange(POINTS) < 50
    las.write(str(path))
    return path


@pytest.mark.parametrize(
    ("name", "form", "version"),
    [("a.las", 1, "1.2"), ("a.las", 3, "1.3"), ("a.las", 6, "1.4"), ("a.laz", 0, "1.2"), ("a.laz", 7, "1.4")],
)
def test_withheld_points_are_left_out_and_noise_on_request(
    tmp_path: Path, name: str, form: int, version: str
) -> None:
    path = marked(tmp_path / name, form, version)
    cloud, found = read_cloud(path), describe(path)
    assert (cloud.points, cloud.dropped, len(cloud.xyz)) == (POINTS, 20, POINTS - 20)
    assert (found.points, found.dropped) == (POINTS, 20)
    assert found.bounds[1][2] == cloud.bounds[1][2] == 2000.0
    assert not cloud.columns["withheld"].any()
    assert cloud.warnings == found.warnings
    said = " ".join(cloud.warnings)
    assert "20 points left out: flagged withheld" in said
    assert "11 points are classified as noise (classes 7 and 18) and kept" in said
    assert "7 points are flagged synthetic" in said
    made = divide([path], tmp_path / "map", SETTINGS)
    assert (made.points_read, made.dropped, made.points) == (POINTS, 20, POINTS - 20)
    assert all(any(warning in note for note in made.notes) for warning in cloud.warnings)

    cloud = read_cloud(path, drop_noise=True)
    assert (cloud.dropped, len(cloud.xyz), cloud.bounds[1][2]) == (31, POINTS - 31, 0.0)
    assert "11 points left out: classified as noise" in " ".join(cloud.warnings)
    made = divide(
        [path],
        tmp_path / "map",
        DivideSettings(durable=False, force=True, drop_noise=True, fields=("x", "y", "z")),
    )
    assert made.bounds is not None
    assert (made.dropped, made.points, made.bounds[1][2]) == (31, POINTS - 31, 0.0)
    assert any("11 points left out: classified as noise" in note for note in made.notes)


def test_a_served_cloud_leaves_out_the_same(tmp_path: Path) -> None:
    path, cache = marked(tmp_path / "a.las", 6, "1.4"), str(tmp_path / "cache")
    for drop, kept, words in ((False, 980, "are classified as noise"), (True, 969, "11 points left out")):
        catalogue = find_origin(str(path), cache_dir=cache, drop_noise=drop).load()
        clouds = [read_cloud(catalogue.id(index)) for index in range(len(catalogue))]
        assert sum(len(cloud.xyz) for cloud in clouds) == kept
        assert words in " ".join(catalogue.problems)
        assert "20 points left out: flagged withheld" in " ".join(catalogue.problems)
    write_pcd(tmp_path / "a.pcd", {axis: np.zeros(3, np.float32) for axis in "xyz"})
    with pytest.raises(BadRequest, match="noise is not left out"):
        find_origin(str(tmp_path / "a.pcd"), cache_dir=cache, drop_noise=True)


def test_the_command_line_counts_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = marked(tmp_path / "a.las", 6, "1.4")
    assert main(["inspect", str(path)]) == 0
    assert "1,000, 20 left out" in capsys.readouterr().out
    assert main(["divide", str(path), str(tmp_path / "map"), "--drop-noise", "--quiet"]) == 0
    assert "969 of 1,000 read, 31 left out" in capsys.readouterr().out


def test_points_left_out_do_not_choose_the_frame(tmp_path: Path) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.01)
    las = laspy.LasData(header)
    x = 690_000 + np.arange(POINTS) * 0.1
    x[:3] = 0.0
    las.x, las.y, las.z = x, x + 4_640_000, x * 0
    las.y[:3] = 0.0
    las.withheld = np.arange(POINTS) < 3
    las.write(str(tmp_path / "a.las"))
    made = divide([tmp_path / "a.las"], tmp_path / "map", SETTINGS)
    assert (dict(made.fields)["x"], made.points) == ("<f4", POINTS - 3)
    assert made.origin[0] == pytest.approx(690_050, abs=50)


def test_all_points_withheld(tmp_path: Path) -> None:
    path = marked(tmp_path / "a.las", 6, "1.4")
    las = laspy.read(path)
    las.withheld = np.ones(POINTS, np.uint8)
    las.write(str(path))
    assert len(read_cloud(path).xyz) == 0
    assert np.isnan(describe(path).bounds[0]).all()
    with pytest.raises(MapDataError, match="no finite point"):
        divide([path], tmp_path / "map", SETTINGS)


class Stop(NoProgress):
    """Ends a run when half of its points are read."""

    points = 0

    def advance(self, points: int) -> None:
        self.points += points
        if self.points > 1.5 * POINTS:
            raise KeyboardInterrupt


def test_a_resumed_run_counts_each_point_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmmap.dividing.divide.block_points_for", lambda *_: 130)
    paths = [marked(tmp_path / name, 6, "1.4") for name in ("a.las", "b.las", "c.laz")]
    whole = divide(paths, tmp_path / "whole", SETTINGS)
    settings = DivideSettings(durable=False, checkpoint_s=0.0, resume=True)
    with pytest.raises(KeyboardInterrupt):
        divide(paths, tmp_path / "map", settings, progress=Stop())
    made = divide(paths, tmp_path / "map", settings)
    assert POINTS < made.resumed_points < 2 * POINTS
    assert made.notes == whole.notes
    assert (made.points, made.dropped) == (whole.points, whole.dropped) == (3 * 980, 60)


# --- float32 far from the origin, and rounding --------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_float32_at_large_coordinates_is_named(tmp_path: Path, suffix: str) -> None:
    def written(name: str, offset: float, kind: str) -> Path:
        path = tmp_path / f"{name}{suffix}"
        values = {
            axis: (np.arange(500) * 0.3 + (0 if axis == "z" else offset)).astype(kind) for axis in "xyz"
        }
        if suffix == ".pcd":
            write_pcd(path, values)
        else:
            fields = "".join(f"property {'float' if kind == 'f4' else 'double'} {axis}\n" for axis in "xyz")
            head = f"ply\nformat binary_little_endian 1.0\nelement vertex 500\n{fields}end_header\n"
            path.write_bytes(
                head.encode() + np.column_stack(list(values.values())).astype(f"<{kind}").tobytes()
            )
        return path

    path = written("far", 5_300_000.0, "f4")
    (warning,) = describe(path).warnings
    assert "float32" in warning
    assert "multiples of 0.5" in warning
    assert read_cloud(path).warnings == (warning,)
    made = divide([path], tmp_path / "map", SETTINGS)
    assert [note for note in made.notes if "multiples of 0.5" in note]
    assert "multiples of 0.03125" in describe(written("nearer", 300_000.0, "f4")).warnings[0]
    assert not describe(written("near", 10_000.0, "f4")).warnings
    assert not describe(written("double", 5_300_000.0, "f8")).warnings


def test_rounded_text_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    xyz = rng.random((300, 3)) * 500 + (689_000, 5_330_000, 0)
    for digits, step in ((6, "10"), (5, "100"), (7, "1"), (9, "")):
        path = tmp_path / "a.xyz"
        path.write_text("".join(" ".join(f"{value:.{digits}g}" for value in row) + "\n" for row in xyz))
        said = " ".join(describe(path).warnings)
        assert (f"y are multiples of {step}:" in said) == bool(step), said
        assert ("multiples" in said) == bool(step), said


# --- columns without names ------------------------------------------------------------------------------


def rows(*columns: object) -> str:
    return "".join(" ".join(map(str, row)) + "\n" for row in zip(*columns, strict=True))


N = 20
XYZ = [(np.random.default_rng(axis).random(N) * 50).round(3).tolist() for axis in range(3)]
RGB = [np.random.default_rng(axis).integers(0, 256, N).tolist() for axis in range(3)]


def test_a_colour_in_front_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    for text in (
        rows(*RGB, *XYZ),
        rows(*RGB, [7] * N, *XYZ),
        rows(*RGB, *XYZ, [7] * N, [8] * N),
        rows([10] * N, [20] * N, [30] * N, *XYZ),
        rows(*RGB, *XYZ).replace(" ", ";"),
    ):
        path.write_text(text)
        with pytest.raises(MapDataError, match="columns 1 to 3 look like a colour") as caught:
            read_cloud(path)
        assert "r g b x y z" in caught.value.hint
    path.write_text("r g b x y z\n" + rows(*RGB, *XYZ))
    assert read_cloud(path).xyz[:, 0].tolist() == XYZ[0]
    assert not read_cloud(path).warnings


@pytest.mark.parametrize("colour", [[0.5, 0.25, 0.75], [65535, 3000, 0], [-1, 0, 3], [256, 1, 2]])
def test_what_is_no_colour_is_not_called_one(tmp_path: Path, colour: list[float]) -> None:
    path = tmp_path / "a.txt"
    path.write_text(rows(*XYZ, *([value] * N for value in colour)))
    cloud = read_cloud(path)
    assert list(cloud.columns) == ["xyz", "column_4", "column_5", "column_6"]
    assert "columns 4 to 6 are no colours" in " ".join(cloud.warnings)
    path.write_text(rows(*XYZ, *RGB))
    assert list(read_cloud(path).columns) == ["xyz", "red", "green", "blue"]
    (tmp_path / "a.xyzrgb").write_text(rows(*XYZ, *([value / 300] * N for value in range(3))))
    assert list(read_cloud(tmp_path / "a.xyzrgb").columns) == ["xyz", "red", "green", "blue"]


def test_a_lattice_with_normals_or_named_colours_is_no_colour(tmp_path: Path) -> None:
    cube = [[value % base for value in range(N)] for base in (3, 5, 7)]
    normal = [[0.6] * N, [0.0] * N, [0.8] * N]
    for name, columns in (
        ("a.txt", normal),
        ("a.xyzn", normal),
        ("a.xyzrgb", [[0.1] * N, [0.2] * N, [0.3] * N]),
    ):
        (tmp_path / name).write_text(rows(*cube, *columns))
        assert read_cloud(tmp_path / name).xyz[:, 1].tolist() == cube[1]


def test_row_numbers_and_flat_coordinates_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    for first in (0, 1, 1000):
        path.write_text(rows(range(first, first + N), *XYZ).replace(" ", ","))
        made = divide([path], tmp_path / "map", SETTINGS)
        for said in (read_cloud(path).warnings, describe(path).warnings, made.notes):
            assert "the first column counts the rows" in " ".join(said)
    path.write_text(rows([2, *range(7, 6 + N)], *XYZ))  # rows were filtered
    assert "the first column counts the rows" in " ".join(read_cloud(path).warnings)
    path.write_text(rows([4.5] * N, *XYZ).replace(" ", ","))
    made = divide([path], tmp_path / "map", SETTINGS)
    for said in (read_cloud(path).warnings, describe(path).warnings, made.notes):
        assert "all points have the same x (4.5)" in " ".join(said)
    path.write_text("id,x,y,z\n" + rows(range(N), *XYZ).replace(" ", ","))
    assert not read_cloud(path).warnings


def test_rows_of_zeros_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.pts"
    path.write_text(f"{N + 2}\n" + rows(*XYZ, [1] * N) + "0 0 0 0\n" * 2)
    assert "2 points are at exactly (0, 0, 0)" in " ".join(read_cloud(path).warnings)


def test_heights_that_stand_for_none_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x,y,z\n1,2,3\n4,5,-9999\n6,7,-32768.0\n8,9,-9998\n")
    assert "2 points have a z of -9999 or" in " ".join(read_cloud(path).warnings)


@pytest.mark.parametrize("columns", [3, 6])
def test_a_colour_of_shares_in_front_is_named(tmp_path: Path, columns: int) -> None:
    path, shares = tmp_path / "a.txt", [[value / 255 for value in values] for values in RGB]
    path.write_text(rows(*shares, *[XYZ, RGB][columns > 3]))
    said = " ".join(read_cloud(path).warnings)
    assert ("columns 1 to 3 lie within 0 and 1" in said) == (columns == 3)  # a cloud with a colour may


@pytest.mark.parametrize(
    ("first", "odd"),
    [
        (np.arange(200) % 64, "has integers alone, unlike the next three"),
        (np.arange(200)[::-1], "has integers alone"),
        (1.6e9 + np.arange(200) * 0.0625, "rises with each row, as times do"),
        (np.arange(200) * 3.0, "counts the rows"),
        (np.random.default_rng(2).normal(size=200), ""),
    ],
)
def test_a_first_column_unlike_a_coordinate_is_named(
    tmp_path: Path, first: NDArray[np.float64], odd: str
) -> None:
    xyz = np.random.default_rng(1).normal(size=(200, 3)) * 10
    path = tmp_path / "a.xyz"
    np.savetxt(path, np.column_stack([first, xyz]), fmt="%.4f")
    said = " ".join(read_cloud(path).warnings)
    assert f"the first column {odd}" in said if odd else "first column" not in said


@pytest.mark.parametrize(
    ("header", "factor", "rounded"),
    [("x [mm],y [mm],z [mm]", 1, False), ("x [mm],y [mm],z [mm]", 1000, True), ("x,y,z", 1, True)],
)
def test_rounding_is_looked_at_in_metres(tmp_path: Path, header: str, factor: int, rounded: bool) -> None:
    path = tmp_path / "a.csv"
    xyz = (np.arange(600).reshape(200, 3) + 691_000) * factor
    np.savetxt(path, xyz, fmt="%d", delimiter=",", header=header, comments="")
    assert ("rounded when the file was written" in " ".join(read_cloud(path).warnings)) == rounded
