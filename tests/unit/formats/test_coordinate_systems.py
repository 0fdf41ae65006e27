# SPDX-License-Identifier: Apache-2.0
"""Units and coordinate systems: read wherever they stand, converted or refused, kept in the map."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest

from shmmap.dividing.divide import divide
from shmmap.dividing.merge import merge
from shmmap.dividing.settings import DivideSettings
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.cloud import describe, read_cloud
from shmmap.formats.coordinate_system import (
    FEET,
    GEOGRAPHIC_SYSTEM,
    METRE,
    degrees_warning,
    geokey_system,
    wkt_system,
)
from shmmap.formats.pcd.writer import write_pcd
from shmmap.origin.map_directory import load_single_pcd, open_map
from shmmap.origin.map_report import MapFrame, read_map_frame

FT, US_FT = FEET["ft"].metres, FEET["us-ft"].metres
GEOGCS = 'GEOGCS["NAD83",DATUM["D",SPHEROID["GRS 1980",6378137,298.257]],UNIT["degree",0.0174532925199433]]'
PROJCS = (
    'PROJCS["NAD83 / Texas Central (ftUS)",'
    + GEOGCS
    + (
        ',PROJECTION["Lambert_Conformal_Conic_2SP"],PARAMETER["false_easting",2296583.333],'
        'UNIT["US survey foot",0.3048006096012192,AUTHORITY["EPSG","9003"]],AUTHORITY["EPSG","2277"]]'
    )
)
UTM = 'PROJCS["WGS 84 / UTM zone 32N",' + GEOGCS + ',UNIT["metre",1],AUTHORITY["EPSG","32632"]]'
HEIGHT_FT = 'VERT_CS["NAVD88 height (ft)",VERT_DATUM["N",2005],UNIT["foot",0.3048],AXIS["Up",UP]]'
HEIGHT_M = 'VERT_CS["NAVD88 height",VERT_DATUM["N",2005],UNIT["metre",1.0]]'
WKT2 = """PROJCRS["NAD83(2011) / Oregon GIC Lambert (ft)",
  BASEGEOGCRS["NAD83(2011)",DATUM["D",ELLIPSOID["GRS 1980",6378137,298.257,LENGTHUNIT["metre",1]]]],
  CONVERSION["O",METHOD["Lambert"],PARAMETER["Easting",1312335.958,LENGTHUNIT["foot",0.3048]]],
  CS[Cartesian,2],AXIS["easting (X)",east,ORDER[1]],AXIS["northing (Y)",north,ORDER[2]],
  LENGTHUNIT["foot",0.3048],ID["EPSG",6557]]"""
WKT2_3D = WKT2.replace("CS[Cartesian,2]", "CS[Cartesian,3]").replace(
    'LENGTHUNIT["foot",0.3048],ID["EPSG",6557]]',
    'AXIS["up",up,ORDER[3],LENGTHUNIT["metre",1]],ID["EPSG",6557]]',
).replace("ORDER[1]]", 'ORDER[1],LENGTHUNIT["foot",0.3048]]').replace(
    "ORDER[2]]", 'ORDER[2],LENGTHUNIT["foot",0.3048]]'
)  # fmt: skip
VERTCRS = 'VERTCRS["H",VDATUM["N"],CS[vertical,1],AXIS["gravity-related height (H)",up],LENGTHUNIT["{}",{}]]'


@pytest.mark.parametrize(
    ("text", "plane", "height", "epsg"),
    [
        (PROJCS, US_FT, US_FT, 2277),
        (UTM, 1.0, 1.0, 32632),
        (f'COMPD_CS["both",{PROJCS},{HEIGHT_FT}]', US_FT, FT, 2277),
        (f'COMPD_CS["both",{PROJCS},{HEIGHT_M}]', US_FT, 1.0, 2277),
        (f'COMPD_CS["both",{UTM},{HEIGHT_FT}]', 1.0, FT, 32632),
        (WKT2, FT, FT, 6557),
        (WKT2_3D, FT, 1.0, 6557),
        (f'COMPOUNDCRS["both",{WKT2},{VERTCRS.format("US survey foot", 0.30480061)}]', FT, US_FT, 6557),
        (f'BOUNDCRS[SOURCECRS[{WKT2}],TARGETCRS[{UTM}],ABRIDGEDTRANSFORMATION["t"]]', FT, FT, 6557),
        ('LOCAL_CS["site",LOCAL_DATUM["d",0],UNIT["US survey foot",0.3048006096]]', US_FT, US_FT, 0),
        ('ENGCRS["site",EDATUM["d"],CS[Cartesian,2],AXIS["x",east],UNIT["foot",0.3048]]', FT, FT, 0),
        (f'{PROJCS},VERTCS["NAVD_Foot_US",UNIT["Foot_US",0.3048006096012192]]', US_FT, US_FT, 2277),
        ('PROJCS["odd",UNIT["foot_us"]]', US_FT, US_FT, 0),
        ('PROJCS("round",UNIT("foot",0.3048))', FT, FT, 0),
        (UTM.replace('UNIT["metre",1]', 'UNIT["kilometre",1000]'), 1000.0, 1000.0, 32632),
        ('GEOCCS["ecef",DATUM["D"],UNIT["metre",1]]', 1.0, 1.0, 0),
        (f'COMPD_CS["c",{UTM},VERT_CS["d",UNIT["metre",1],AXIS["Depth",DOWN]]]', 1.0, 0.0, 32632),
        ('ENGCRS["s",AXIS["x",east,UNIT["metre",1]],AXIS["y",north,UNIT["foot",0.3048]]]', 0.0, 0.0, 0),
    ],
)  # fmt: skip
def test_units_in_wkt(text: str, plane: float, height: float, epsg: int) -> None:
    found = wkt_system(text)
    assert found is not None
    assert (found.geographic, found.epsg) == (False, epsg)
    assert [unit.metres for unit in found.units] == pytest.approx([plane, height], rel=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        GEOGCS,
        f'COMPD_CS["WGS 84 + height",{GEOGCS},{HEIGHT_M}]',
        'GEOGCRS["WGS 84",DATUM["D"],CS[ellipsoidal,2],AXIS["lat",north],UNIT["degree",0.0174532925199433]]',
        f'COMPOUNDCRS["c",GEODCRS["WGS 84",DATUM["D"],CS[ellipsoidal,2]],{VERTCRS.format("metre", 1)}]',
    ],
)
def test_degrees_in_wkt(text: str) -> None:
    found = wkt_system(text)
    assert found is not None
    assert found.geographic
    assert found.units[1] == METRE


@pytest.mark.parametrize("text", ["", "hello", "PROJCS[", "[" * 10_000, 'A["b",' * 10_000, '"' * 99, "\0"])
def test_what_is_no_wkt(text: str) -> None:
    assert wkt_system(text) is None


def keys(*entries: tuple[int, int], texts: str = "", doubles: tuple[float, ...] = ()) -> list[laspy.VLR]:
    """Records of GeoTIFF keys: shorts, one citation (3073) and doubles (3077)."""
    rows = [(key, 0, 1, value) for key, value in entries]
    if texts:
        rows.append((3073, 34737, len(texts), 0))
    if doubles:
        rows.append((3077, 34736, 1, 0))
    directory = struct.pack(f"<{4 + 4 * len(rows)}H", 1, 1, 0, len(rows), *(v for row in rows for v in row))
    return [
        laspy.VLR("LASF_Projection", 34735, "keys", directory),
        laspy.VLR("LASF_Projection", 34736, "doubles", struct.pack(f"<{len(doubles)}d", *doubles)),
        laspy.VLR("LASF_Projection", 34737, "texts", texts.encode() + b"\0"),
    ]


@pytest.mark.parametrize(
    ("records", "plane", "height"),
    [
        (keys((1024, 1), (3072, 32632), (3076, 9001)), 1.0, 1.0),
        (keys((1024, 1), (3072, 2277), (3076, 9003)), US_FT, US_FT),
        (keys((1024, 1), (3076, 9002), (4099, 9001)), FT, 1.0),
        (keys((1024, 1), (3076, 9001), (4099, 9003)), 1.0, US_FT),
        (keys((1024, 1), (3072, 2277)), US_FT, US_FT),
        (keys((1024, 1), (3072, 2913)), FT, FT),
        (keys((1024, 1), texts="NAD83(2011) / Oregon North (ft)|"), FT, FT),
        (keys((1024, 1), texts="NAD83 / Florida East (ftUS)|"), US_FT, US_FT),
        (keys((1024, 1), (3076, 32767), doubles=(0.3048006096,)), US_FT, US_FT),
        (keys((1024, 1), (2052, 9003)), US_FT, US_FT),
        (keys((1024, 1), (3076, 12345)), 0.0, 0.0),
    ],
)
def test_units_in_geotiff_keys(records: list[laspy.VLR], plane: float, height: float) -> None:
    found = geokey_system(*(record.record_data for record in records))
    assert found is not None
    assert [unit.metres for unit in found.units] == pytest.approx([plane, height], rel=1e-12)


def write_las(
    path: Path, *, wkt: str = "", records: list[laspy.VLR] | None = None, extended: bool = False
) -> Path:  # fmt: skip
    """Four points of a square of 100 units, in a file whose system is as given."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.array([500.0, 600.0, 0.0])
    las = laspy.LasData(header)
    las.x, las.y, las.z = [500.0, 600.0, 500.0, 600.0], [600.0, 600.0, 700.0, 700.0], [10.0, 20.0, 30.0, 40.0]
    record = laspy.vlrs.known.WktCoordinateSystemVlr(wkt)
    if wkt and extended:
        las.evlrs = laspy.vlrs.vlrlist.VLRList([record])
    elif wkt:
        header.vlrs.append(record)
    for one in records or ():
        header.vlrs.append(one)
    header.global_encoding.wkt = bool(wkt)
    las.write(str(path))
    return path


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("where", ["vlr", "evlr", "keys"])
def test_feet_are_refused_with_the_factor_and_converted(tmp_path: Path, suffix: str, where: str) -> None:
    path = write_las(
        tmp_path / f"a.{suffix}", wkt="" if where == "keys" else PROJCS, extended=where == "evlr",
        records=keys((1024, 1), (3072, 2277), (3076, 9003)) if where == "keys" else None,
    )  # fmt: skip
    assert any("US survey feet (0.304800609601 m)" in warning for warning in describe(path).warnings)
    assert any("US survey feet" in warning for warning in read_cloud(path).warnings)
    with pytest.raises(MapDataError, match=r"not in metres.*US survey feet") as caught:
        divide([path], tmp_path / "map", DivideSettings(durable=False))
    assert caught.value.cause == "not_metres"
    assert "--unit auto multiplies them by 0.304800609601" in caught.value.hint
    assert not (tmp_path / "map").exists()
    made = divide([path], tmp_path / "map", DivideSettings(durable=False, check=True, unit="auto"))
    assert made.bounds is not None
    for values, expected in zip(made.bounds, ([500, 600, 10], [600, 700, 40]), strict=True):
        assert np.array(values) + made.origin == pytest.approx(np.array(expected) * US_FT, abs=1e-4)
    assert made.unit_m == (US_FT, US_FT)
    assert made.crs == ("EPSG:2277" if where == "keys" else "NAD83 / Texas Central (ftUS) (EPSG:2277)")
    assert made.notes == ["converted to metres: x, y and z are in US survey feet (0.304800609601 m)"]
    frame = read_map_frame(tmp_path / "map")
    assert frame == MapFrame(made.origin, made.crs, (US_FT, US_FT))
    assert open_map(tmp_path / "map", cache_dir=tmp_path / "cache").load().frame == frame


@pytest.mark.parametrize(
    ("wkt", "unit", "vertical_unit", "plane", "height"),
    [
        (f'COMPD_CS["c",{UTM},{HEIGHT_FT}]', "auto", "", 1.0, FT),
        (f'COMPD_CS["c",{UTM},{HEIGHT_FT}]', "", "auto", 1.0, FT),
        (f'COMPD_CS["c",{UTM},{HEIGHT_FT}]', "m", "m", 1.0, 1.0),
        (f'COMPD_CS["c",{PROJCS},{HEIGHT_M}]', "auto", "", US_FT, 1.0),
        (f'COMPD_CS["c",{PROJCS},{HEIGHT_M}]', "us-ft", "", US_FT, 1.0),
        (PROJCS, "us-ft", "m", US_FT, 1.0),
        (PROJCS, "m", "", 1.0, 1.0),
        (UTM, "ft", "", FT, FT),
        ("", "us-ft", "", US_FT, US_FT),
        ("", "ft", "m", FT, 1.0),
        ("", "", "ft", 1.0, FT),
        (UTM, "", "", 1.0, 1.0),
    ],
)
def test_plane_and_height_apart(
    tmp_path: Path, wkt: str, unit: str, vertical_unit: str, plane: float, height: float
) -> None:
    path = write_las(tmp_path / "a.las", wkt=wkt)
    settings = DivideSettings(
        durable=False, check=True, unit=unit, vertical_unit=vertical_unit, translate="none"
    )
    made = divide([path], tmp_path / "map", settings)
    assert made.bounds is not None
    assert made.bounds[1] == pytest.approx([600 * plane, 700 * plane, 40 * height], abs=1e-4)


def test_heights_alone_in_feet_are_refused(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las", wkt=f'COMPD_CS["c",{UTM},{HEIGHT_FT}]')
    with pytest.raises(MapDataError, match="z in international feet") as caught:
        divide([path], tmp_path / "map", DivideSettings(durable=False))
    assert "heights by 0.3048" in caught.value.hint


def test_what_no_factor_is_known_of(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las", records=keys((1024, 1), (3076, 12345)))
    for unit in ("", "auto"):
        with pytest.raises(MapDataError, match="EPSG:12345") as caught:
            divide([path], tmp_path / "map", DivideSettings(durable=False, unit=unit))
        assert "--unit" in caught.value.hint
    with pytest.raises(BadRequest, match="unit 'feet'"):
        divide([path], tmp_path / "map", DivideSettings(durable=False, unit="feet"))


def test_files_of_different_units_and_systems(tmp_path: Path) -> None:
    """Tiles in feet and in metres become one map in metres; systems of other codes are not mixed."""
    one = write_las(tmp_path / "a.las", wkt=PROJCS.replace(',AUTHORITY["EPSG","2277"]]', "]"))
    other = write_las(tmp_path / "b.las")
    made = divide([one, other], tmp_path / "map", DivideSettings(durable=False, check=True, unit="auto"))
    assert made.bounds is not None
    assert made.bounds[0] == pytest.approx([500 * US_FT, 600 * US_FT, 10 * US_FT], abs=1e-4)
    assert made.bounds[1] == pytest.approx([600, 700, 40])
    write_las(tmp_path / "b.las", wkt=UTM)
    write_las(tmp_path / "c.las", wkt=UTM.replace("32632", "32633"))
    with pytest.raises(MapDataError, match="EPSG:32633") as caught:
        divide([other, tmp_path / "c.las"], tmp_path / "two", DivideSettings(durable=False))
    assert caught.value.cause == "different_systems"


def test_other_formats_are_converted_where_one_says_their_unit(tmp_path: Path) -> None:
    write_pcd(tmp_path / "a.pcd", {axis: np.array([10.0, 20.0], np.float32) for axis in "xyz"})
    (tmp_path / "b.xyz").write_text("10 10 10\n20 20 20\n")
    for name in ("a.pcd", "b.xyz"):
        made = divide(
            [tmp_path / name], tmp_path / name[0], DivideSettings(durable=False, check=True, unit="ft")
        )
        assert made.bounds is not None
        assert made.bounds[1] == pytest.approx([6.096] * 3, abs=1e-5)


def test_merging_feet_is_refused(tmp_path: Path) -> None:
    """A PCD file cannot say its unit."""
    path = write_las(tmp_path / "a.las", wkt=PROJCS)
    with pytest.raises(MapDataError, match="US survey feet"):
        merge([path], tmp_path / "out.pcd")


def test_text_and_keys_that_disagree_are_said(tmp_path: Path) -> None:
    path = write_las(tmp_path / "a.las", wkt=PROJCS, records=keys((1024, 1), (3076, 9001)))
    warnings = describe(path).warnings
    assert any("different units: the WKT is used" in warning for warning in warnings)
    assert any("US survey feet" in warning for warning in warnings)


# --- clouds in degrees are warned about; clouds in metres are not, however small they are -----------------


@pytest.mark.parametrize(
    ("low", "high", "warned"),
    [
        ((8.40, 49.00, 110.0), (8.43, 49.02, 160.0), True),  # a town in Germany
        ((-122.5, 37.7, 0.0), (-122.3, 37.9, 280.0), True),
        ((139.6, 35.6, -5.0), (139.8, 35.7, 40.0), True),
        ((-80.0, -60.0, -2.0), (90.0, 70.0, 12.0), False),  # a LiDAR scan
        ((0.0, 0.0, 0.0), (20.0, 20.0, 8.0), False),  # one cell
        ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.2), False),  # a bunny
        ((5.0, 6.0, 0.0), (5.3, 6.3, 4.0), False),  # a lamp post
        ((512000.0, 5403000.0, 300.0), (512000.1, 5403000.1, 350.0), False),
        ((np.nan,) * 3, (np.nan,) * 3, False),
    ],
)
def test_what_looks_like_degrees(low: tuple[float, ...], high: tuple[float, ...], warned: bool) -> None:
    warning = degrees_warning(np.array(low), np.array(high))
    assert bool(warning) == warned
    assert ("look like degrees" in warning) == warned


def town() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    return {"x": 8.4 + rng.random(500) * 0.02, "y": 49.0 + rng.random(500) * 0.02, "z": rng.random(500) * 40}


def test_inspect_divide_and_serve_say_so(tmp_path: Path) -> None:
    write_pcd(tmp_path / "town.pcd", town())
    (warning,) = describe(tmp_path / "town.pcd").warnings
    assert "look like degrees" in warning
    made = divide([tmp_path / "town.pcd"], tmp_path / "map", DivideSettings(durable=False))
    assert [note for note in made.notes if "look like degrees" in note]
    (problem,) = load_single_pcd(str(tmp_path / "town.pcd")).problems
    assert "look like degrees" in problem


@pytest.mark.parametrize(("model", "named"), [(2, True), (1, False), (None, False)])
@pytest.mark.parametrize("where", ["keys", "plain", "compound", "extended"])
def test_a_geographic_system_in_a_las_file(
    tmp_path: Path, model: int | None, named: bool, where: str
) -> None:
    plane = 'GEOGCS["WGS 84",DATUM["D"]]' if named else 'PROJCS["UTM 32N",GEOGCS["WGS 84"],UNIT["m",1]]'
    wkt = {"plain": plane}.get(where, f'COMPD_CS["both",{plane},VERT_CS["h",UNIT["metre",1]]]')
    write_las(
        tmp_path / "in.las",
        wkt="" if model is None or where == "keys" else wkt,
        records=keys((1024, model)) if model is not None and where == "keys" else None,
        extended=where == "extended",
    )
    assert (GEOGRAPHIC_SYSTEM in describe(tmp_path / "in.las").warnings) == named
    if named:
        for unit in ("", "auto", "ft", "mm"):
            with pytest.raises(MapDataError, match="x and y are degrees") as caught:
                divide([tmp_path / "in.las"], tmp_path / "map", DivideSettings(durable=False, unit=unit))
            assert caught.value.cause == "not_metres"
            assert "UTM" in str(caught.value)
    made = divide([tmp_path / "in.las"], tmp_path / "map", DivideSettings(durable=False, unit="m"))
    assert any(GEOGRAPHIC_SYSTEM in note for note in made.notes) == named
