# SPDX-License-Identifier: Apache-2.0
"""Units and names of coordinates in headers and comments: converted, or refused with the factor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.served_cloud import DividedCloud, find_origin
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import MapDataError
from shmmap.formats.cloud import describe, read_cloud
from shmmap.formats.coordinate_system import GEOGRAPHIC_SYSTEM
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.stated_units import coordinates_of, units_in_comments

FT, US_FT = 0.3048, 1200 / 3937


def header_of(names: str) -> tuple[tuple[int, int, int], tuple[float, float]] | None:
    """Places of x, y and z in a header, and metres of the units of plane and height."""
    found = coordinates_of(names.split(","))
    if found is None:
        return None
    assert not found.problem
    plane, height = found.crs.units if found.crs is not None else (None, None)
    return found.places, (plane.metres if plane else 1.0, height.metres if height else 1.0)


@pytest.mark.parametrize(
    ("names", "plane", "height"),
    [
        ("x [mm],y [mm],z [mm]", 0.001, 0.001),
        ("x(mm),y(mm),z(mm)", 0.001, 0.001),
        ("X_mm,Y_mm,Z_mm", 0.001, 0.001),
        ("x/mm,y/mm,z/mm", 0.001, 0.001),
        ("x in mm,y in mm,z in mm", 0.001, 0.001),
        ("x-millimeters,y-millimeters,z-millimeters", 0.001, 0.001),
        ("X [MM],Y [ mm ],Z [Millimetres]", 0.001, 0.001),
        ("x {cm},y {cm},z {cm}", 0.01, 0.01),
        ("x [ft],y [ft],z [ft]", FT, FT),
        ("x ('),y ('),z (')", FT, FT),
        ("x [us-ft],y [ftUS],z [US survey foot]", US_FT, US_FT),
        ("X_ft_us,Y_usft,Z_us_ft", US_FT, US_FT),
        ("x [ft(us)],y [ft (US)],z [m]", US_FT, 1.0),
        ("x [m],y [m],z [ft]", 1.0, FT),
        ("x [km],y [km],z [m]", 1000.0, 1.0),
        ("x [in],y_in,z (inches)", 0.0254, 0.0254),
        ("x [µm],y [μm],z [um]", 1e-6, 1e-6),
        ("xmm,Ymm,zmm", 0.001, 0.001),
        ("xm,ym,zm", 1.0, 1.0),
        ("X(East) [mm],Y(North) [mm],Z(Up) [mm]", 0.001, 0.001),
        ("x [mm]:float,y [mm]:float,z [mm]:float", 0.001, 0.001),
        ("x (unit: mm),y [units=mm],z (all in mm)", 0.001, 0.001),
        ("x [0.001 m],y [0.001 m],z [1e-3 m]", 0.001, 0.001),
        ("x [m],y [m],z [m]", 1.0, 1.0),
        ("x [m],y,z", 1.0, 1.0),
        ("x [mm],y [mm],z", 0.001, 0.0),  # z may be in either: not decided
        ("x,y,z [mm]", 0.0, 0.001),
        ("x [px],y [px],z [px]", 1.0, 1.0),
    ],
)
def test_units_of_columns(names: str, plane: float, height: float) -> None:
    found = header_of(names)
    assert found is not None
    assert found[0] == (0, 1, 2)
    assert found[1] == pytest.approx((plane, height), rel=1e-12)
    more = header_of(f"intensity [%],{names},gps_time [s],angle [deg]")
    assert more is not None
    assert more == ((1, 2, 3), found[1])


@pytest.mark.parametrize(
    ("names", "places"),
    [
        ("intensity,laser_id,azimuth,Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2", (3, 4, 5)),
        ("Points:2,Points:0,Points:1", (1, 2, 0)),
        ("Points_0,Points_1,Points_2,i", (0, 1, 2)),
        ("Points[0],Points[1],Points[2]", (0, 1, 2)),
        ("Points:0,Points:1,Points:2,x,y,z", (3, 4, 5)),
        ("Northing,Easting,Elevation", (1, 0, 2)),
        ("N,E,H", (1, 0, 2)),
        ("id,East [m],North [m],Height [m]", (1, 2, 3)),
        ("X_coord,Y_coord,Z_coord", (0, 1, 2)),
        ("pos_x,pos_y,pos_z", (0, 1, 2)),
        ("x,y,height", (0, 1, 2)),
        ("x,y,z,easting,northing,elevation,lon,lat", (0, 1, 2)),
        ("x,y,easting,northing,elevation", None),  # two planes and one height
        ("x,y,z,x", None),
        ("azimuth,elevation,range", None),
        ("north,east,down", None),
    ],
)
def test_names_of_coordinates(names: str, places: tuple[int, int, int] | None) -> None:
    found = header_of(names)
    assert (found and found[0]) == places


@pytest.mark.parametrize(
    ("comment", "plane", "height"),
    [
        ("units: mm", 0.001, 0.001),
        ("UNITS = US survey feet", US_FT, US_FT),
        ("length_unit mm", 0.001, 0.001),
        ("Unit of length: millimetre (0.001)", 0.001, 0.001),
        ("all coordinates are given in centimeters", 0.01, 0.01),
        ("x, y and z in feet", FT, FT),
        ("xyz [mm]", 0.001, 0.001),
        ("unit of measurement: mm", 0.001, 0.001),
        ("made by a tool, units in cm", 0.01, 0.01),
        ("made by a tool. Units: ft. 1000 points.", FT, FT),
        ("Vertical units: ft", None, FT),
        ("horizontal unit: us-ft", US_FT, None),
        ("mm", 0.001, 0.001),
        ("[ft]", FT, FT),
        ("coordinates: mm", 0.001, 0.001),
        ("values are mm", 0.001, 0.001),
        ("exported in mm", 0.001, 0.001),
        ("Point cloud in millimetres", 0.001, 0.001),
        ("x [cm] y [cm] z [m]", 0.01, 1.0),
        ("units: m m ft", 1.0, FT),
        ("length-unit: 'mm'", 0.001, 0.001),
        ('{"units": "mm"}', 0.001, 0.001),
        ("1 unit = 1 mm", 0.001, 0.001),
        ("unit: 0.001 m", 0.001, 0.001),
        ("z [ft]", None, FT),
        ("heights in feet", None, FT),
        ("elevation units: us-ft", None, US_FT),
        ("x y z", None, None),
        ("resolution in mm: 5", None, None),
        ("scan 12 m high", None, None),
        ("saved in 2 m", None, None),
        ("angle units: deg", None, None),
        ("time unit: m", None, None),
        ("units per metre: 1000", 0.001, 0.001),
        ("metersPerUnit = 0.01", 0.01, 0.01),
        ("all values in units of 0.01 m", 0.01, 0.01),
        ("Position units: feet (US survey)", US_FT, US_FT),
        ("coordinates as mm", 0.001, 0.001),
        ("units -> mm", 0.001, 0.001),
        ("<LinearUnit>Foot_US</LinearUnit>", US_FT, US_FT),
        ("Einheit: mm", 0.001, 0.001),
        ("Vertical datum: NAVD88 (ft)", None, FT),
        ("vertical datum NAVD88, US survey feet", None, FT),  # the last word counts
        ("CRS: EPSG:2277 (ftUS)", US_FT, US_FT),
        ("EPSG:32632", None, None),
        ("EPSG:4326", 0.0, 1.0),
        ('crs PROJCS["x",UNIT["US survey foot",0.3048006096012192]]', US_FT, US_FT),
        ("+proj=lcc +units=us-ft +vunits=m +no_defs", US_FT, 1.0),
        ("+proj=tmerc +to_meter=0.3048", FT, FT),
        ("+proj=longlat +datum=WGS84", 0.0, 1.0),
        ("+proj=utm +zone=32", None, None),
        ("1000 points in 3 scans", None, None),
        ("points in 12 m tiles", None, None),
        ("voxel size 5 mm", None, None),
        ("unit normals in the map frame", None, None),
    ],
)
def test_units_in_comments(comment: str, plane: float | None, height: float | None) -> None:
    found = units_in_comments([comment])
    assert [unit and unit.metres for unit in found] == [
        None if value is None else pytest.approx(value, rel=1e-12) for value in (plane, height)
    ]


def test_comments_that_contradict_each_other_decide_nothing() -> None:
    plane, _ = units_in_comments(["units: mm", "units: cm"])
    assert plane is not None
    assert (plane.metres, "millimetre or centimetre" in plane.name) == (0.0, True)


ROWS = "1000 2000 3000\n4000 5000 6000\n"
TABLE = ROWS.replace(" ", ",")
PCD = (
    "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA ascii\n"
)
PLY = (
    "format ascii 1.0\nelement vertex 2\n"
    + "".join(f"property double {axis}\n" for axis in "xyz")
    + "end_header\n"
)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "x [mm],y [mm],z [mm]\n" + TABLE),
        ("a.csv", '"X (mm)";"Y (mm)";"Z (mm)"\n' + ROWS.replace(" ", ";")),
        ("a.txt", "x [mm] y [mm] z [mm]\n" + ROWS),
        ("a.txt", "//X_mm Y_mm Z_mm\n" + ROWS),
        ("a.xyz", "# x y z\n# units: mm\n" + ROWS),
        ("a.pts", "2\n# coordinates in mm\n" + ROWS),
        ("a.csv", "x,y,z\nmm,mm,mm\n" + TABLE),
        ("a.csv", "# x,y,z\n# [mm],[mm],[mm]\n" + TABLE),
        ("a.ply", "ply\ncomment units: mm\n" + PLY + ROWS),
        ("a.ply", "ply\nobj_info unit = millimetres\n" + PLY + ROWS),
        ("a.pcd", "# .PCD v0.7 - Point Cloud Data file format\n# unit: mm\n" + PCD + ROWS),
        ("a.pcd", "# coordinates in mm\n" + PCD + ROWS),
        ("a.pcd", PCD.replace("WIDTH", "UNITS mm\nWIDTH") + ROWS),
    ],
)
def test_stated_units_are_refused_with_the_factor_and_converted(tmp_path: Path, name: str, text: str) -> None:
    path, out = tmp_path / name, tmp_path / "map"
    path.write_text(text)
    assert read_cloud(path).xyz.tolist() == [[1000, 2000, 3000], [4000, 5000, 6000]]
    said = "coordinates are not in metres: x, y and z are in millimetres (0.001 m)"
    assert said in read_cloud(path).warnings
    assert said in describe(path).warnings
    with pytest.raises(MapDataError, match="not in metres") as caught:
        divide([path], out, DivideSettings(durable=False))
    assert (caught.value.cause, "by 0.001" in caught.value.hint) == ("not_metres", True)
    origin = find_origin(str(path), cache_dir=str(tmp_path / "cache"))
    assert isinstance(origin, DividedCloud)
    for unit, factor in (("auto", 0.001), ("mm", 0.001), ("m", 1.0), ("cm", 0.01)):
        made = divide([path], out, DivideSettings(durable=False, unit=unit, force=True))
        assert made.bounds is not None
        np.testing.assert_allclose(made.bounds[1], np.array([4000, 5000, 6000]) * factor)
        about_units = [note for note in made.notes if "metres" in note]
        assert len(about_units) == 1, made.notes
        assert ("taken as metres" if unit == "m" else "converted to metres") in about_units[0]
        assert made.unit_m == (factor, factor)


def test_a_comment_of_units_does_not_stay_with_the_next_pcd_file(tmp_path: Path) -> None:
    for name, comment, warned in (
        ("a", "", False),
        ("b", "# units: mm\n", True),
        ("c", "# made by\n", False),
    ):
        (tmp_path / f"{name}.pcd").write_text(comment + PCD + ROWS)
        with PcdReader(tmp_path / f"{name}.pcd") as reader:
            assert (reader.header.crs is not None) == warned


@pytest.mark.parametrize(
    "header",
    ["lon,lat,alt", "x [deg],y [deg],z [m]", "Longitude (°),Latitude (°),h", "# units: degrees\nx,y,z"],
)
def test_degrees_are_refused(tmp_path: Path, header: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(header + "\n8.4,49.0,110.5\n8.5,49.1,111\n")
    assert read_cloud(path).xyz[0].tolist() == [8.4, 49.0, 110.5]
    assert GEOGRAPHIC_SYSTEM in describe(path).warnings
    for unit in ("", "auto", "ft"):
        with pytest.raises(MapDataError, match="degrees") as caught:
            divide([path], tmp_path / "map", DivideSettings(durable=False, unit=unit))
        assert "UTM" in str(caught.value)


def test_units_that_do_not_go_together(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x [mm],y [m],z [m]\n" + TABLE)
    with pytest.raises(MapDataError, match="different units"):
        read_cloud(path)
    path.write_text("x [mm],y [mm],z\n" + TABLE)
    for unit in ("", "auto"):
        with pytest.raises(MapDataError, match="z in a unit that the header does not state"):
            divide([path], tmp_path / "map", DivideSettings(durable=False, unit=unit))
    made = divide([path], tmp_path / "map", DivideSettings(durable=False, unit="auto", vertical_unit="m"))
    assert made.bounds is not None
    np.testing.assert_allclose(made.bounds[1], [4, 5, 6000])


def test_what_is_no_unit_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x [px],y [px],z [px]\n" + TABLE)
    assert "'x [px]' states no unit that is known" in describe(path).warnings
    made = divide([path], tmp_path / "map", DivideSettings(durable=False))
    assert any("'x [px]' states no unit" in note for note in made.notes)


def test_columns_of_a_named_table_are_found_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(
        '"intensity","laser_id","Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2"\n7,3,10.5,20.5,30.5\n'
    )
    cloud = read_cloud(path)
    assert cloud.xyz.tolist() == [[10.5, 20.5, 30.5]]
    assert list(cloud.columns) == ["xyz", "intensity", "laser_id"]
    path.write_text("Northing,Easting,Elevation\n20.5,10.5,30.5\n")
    assert read_cloud(path).xyz.tolist() == [[10.5, 20.5, 30.5]]
    path.write_text("x,Points:0,Points:1,Points:2,X\n1,2,3,4,5\n")
    assert {name: values[0].tolist() for name, values in read_cloud(path).columns.items()} == {
        "xyz": [2, 3, 4],
        "x_2": 1,
        "X": 5,
    }
    path.write_text("intensity,laser_id,azimuth,range\n1,2,3,4\n")
    with pytest.raises(MapDataError) as caught:
        read_cloud(path)
    assert "leave" not in caught.value.hint


@pytest.mark.parametrize(
    ("header", "unit", "note"),
    [
        (
            "x [mm],y [mm],z [mm]",
            "ft",
            "international feet (0.3048 m), although the file says: x, y and z are in mil",
        ),
        ("x [mm],y [mm],z [mm]", "auto", "converted to metres: x, y and z are in millimetres (0.001 m)"),
        ("x,y,z", "ft", "converted to metres: x, y and z are in international feet (0.3048 m)"),
    ],
)
def test_a_unit_that_differs_from_the_stated_one_is_noted(
    tmp_path: Path, header: str, unit: str, note: str
) -> None:
    (tmp_path / "a.csv").write_text(header + "\n1,2,3\n4,5,6\n")
    settings = DivideSettings(unit=unit, drop_noise=True, durable=False)
    notes = divide([tmp_path / "a.csv"], tmp_path / "map", settings).notes
    (converted,) = (one for one in notes if one.startswith("converted"))
    assert note in converted
    assert ("although" in converted) == ("although" in note)
    assert any("a.csv: --drop-noise had no effect" in one for one in notes)


@pytest.mark.parametrize(
    ("comment", "scale"),
    [("scale: 0.001", "0.001"), ("Scale factor = 1000", "1000"), ("coordinates multiplied by 100", "100"),
     ("scale 1.0", ""), ("grayscale 255", ""), ("made at a scale", "")],
)  # fmt: skip
def test_a_scale_that_a_comment_states_is_named(tmp_path: Path, comment: str, scale: str) -> None:
    for name, text in (
        ("a.xyz", f"# {comment}\n" + ROWS),
        ("a.ply", f"ply\ncomment {comment}\n" + PLY + ROWS),
        ("a.pcd", f"# {comment}\n" + PCD + ROWS),
    ):
        (tmp_path / name).write_text(text)
        said = [note for note in read_cloud(tmp_path / name).warnings if "scale" in note]
        assert said == ([f"a comment states a scale of {scale}, which is not applied"] if scale else [])
