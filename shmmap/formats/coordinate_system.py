# SPDX-License-Identifier: Apache-2.0
"""The coordinate system that a file names (name, units of plane and height), and warnings about it.

LAS files contain it as WKT (OGC 01-009 and ISO 19162, so WKT 1 and 2) or as GeoTIFF keys (OGC 19-008). No
projection library is needed: WKT contains a unit's length, and unit codes are few.  Coordinates in other
units than metres get a warning.  Longitude and latitude cannot be made into a map, since a whole town would
fall into one cell.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:  # the command line parses its options without numpy
    import numpy as np
    from numpy.typing import NDArray


class LengthUnit(NamedTuple):
    """A unit of length and its length in metres; 0 if that is unknown."""

    name: str
    metres: float


METRE: Final = LengthUnit("metre", 1.0)
FEET: Final = {
    "ft": LengthUnit("international foot", 0.3048),
    "us-ft": LengthUnit("US survey foot", 1200 / 3937),
}
"""Feet by the names that options use; the two differ by 2 mm in a kilometre."""

LENGTHS: Final = {
    "mm": LengthUnit("millimetre", 0.001),
    "cm": LengthUnit("centimetre", 0.01),
    "in": LengthUnit("inch", 0.0254),
    **FEET,
}
"""Units other than metres by the names that options use."""

UNITS: Final = ("auto", "m", *LENGTHS)
"""Values of options for units; ``auto``: the unit that each file names."""

_SAME: Final = 5e-8  # metres; lengths in files are rounded, and the two feet differ by 6e-7


@dataclass(frozen=True, slots=True)
class CoordinateSystem:
    """The coordinate system that a file names.

    Attributes
    ----------
    name
        Name in the file, with its EPSG code if the file has one.
    geographic
        Whether x and y are degrees.
    plane, height
        Units of x and y, and of z; None if the file does not name them.
    epsg
        EPSG code of the whole system, or of its horizontal part; 0 if there is none.
    """

    name: str = ""
    geographic: bool = False
    plane: LengthUnit | None = None
    height: LengthUnit | None = None
    epsg: int = 0

    @property
    def units(self) -> tuple[LengthUnit, LengthUnit]:
        """Units of plane and height; by default metres in the plane, and the plane's unit for heights."""
        plane = self.plane or METRE
        return plane, self.height or (METRE if self.geographic else plane)

    @property
    def label(self) -> str:
        """Name and code, as displayed."""
        code = f"EPSG:{self.epsg}" if self.epsg else ""
        return f"{self.name} ({code})" if self.name and code else self.name or code


def _length(name: str, metres: float) -> LengthUnit:
    """Return the unit of a length in metres, under its common name if it has one."""
    for known in (METRE, *FEET.values()):
        if math.isfinite(metres) and abs(metres - known.metres) < _SAME * known.metres:
            return known
    return LengthUnit(name or "unit", metres if math.isfinite(metres) and metres > 0 else 0.0)


# --- WKT ------------------------------------------------------------------------------------------

_TOKEN: Final = re.compile(r'\s*(?:"((?:[^"]|"")*)"|([\[(])|([\])])|,|([^\s,"\[\]()]+))')
_MAX_TEXT: Final = 1 << 20
_MAX_DEPTH: Final = 64
_PLANE: Final = frozenset(
    ("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS", "GEOCCS", "DERIVEDPROJCRS")
)
_DEGREES: Final = frozenset(("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS"))
_GEODETIC: Final = frozenset(("GEODCRS", "GEODETICCRS"))
_HEIGHT: Final = frozenset(("VERT_CS", "VERTCS", "VERTCRS", "VERTICALCRS"))
_COMPOUND: Final = frozenset(("COMPD_CS", "COMPOUNDCRS"))
_AROUND: Final = frozenset(("BOUNDCRS", "SOURCECRS", "FITTED_CS", "COORDINATEMETADATA"))
_AXIS: Final = frozenset(("AXIS",))
_UNITS: Final = frozenset(("UNIT", "LENGTHUNIT"))


@dataclass(slots=True)
class _Node:
    """One WKT bracket: its keyword, and the texts, words and brackets in it."""

    keyword: str
    words: list[str] = field(default_factory=list)
    nodes: list[_Node] = field(default_factory=list)

    def all(self, keywords: frozenset[str]) -> list[_Node]:
        return [node for node in self.nodes if node.keyword in keywords]


def wkt_system(text: str) -> CoordinateSystem | None:
    """Return the system that WKT of any kind describes; None if the text is not WKT of such a system."""
    roots = _trees(text[:_MAX_TEXT])
    return _system(roots[0] if len(roots) == 1 else _Node("COMPD_CS", [], roots))


def _trees(text: str) -> list[_Node]:
    """Return the outermost brackets: one, or two if ESRI appends a system of heights."""
    roots: list[_Node] = []
    stack: list[_Node] = []
    word, at = "", 0
    while found := _TOKEN.match(text, at):
        at = found.end()
        quoted, opened, closed, plain = found.groups()
        if opened:
            if not word or len(stack) >= _MAX_DEPTH:
                break
            node = _Node(word.upper())
            if stack:
                stack[-1].words.pop()
                stack[-1].nodes.append(node)
            stack.append(node)
            word = ""
        elif closed:
            if not stack:
                break
            node = stack.pop()
            if not stack:
                roots.append(node)
        elif quoted is not None or plain:
            word = plain or ""
            if stack:
                stack[-1].words.append(quoted.replace('""', '"') if quoted is not None else plain)
    return roots


def _system(node: _Node) -> CoordinateSystem | None:
    name = node.words[0] if node.words else ""
    epsg = _epsg(node)
    if node.keyword in _COMPOUND:
        parts = [part for part in map(_system, node.nodes) if part is not None]
        plane = next((part for part in parts if part.plane is not None or part.geographic), None)
        height = next((part.height for part in parts if part.height is not None), None)
        if not parts:
            return None
        return CoordinateSystem(
            name=name or parts[0].name,
            geographic=plane is not None and plane.geographic,
            plane=plane.plane if plane is not None else None,
            height=height,
            epsg=epsg or (plane.epsg if plane is not None else 0),
        )
    if node.keyword in _AROUND:
        inner = [part for part in map(_system, node.nodes) if part is not None]
        return inner[0] if inner else None
    units = _units(node)
    if node.keyword in _HEIGHT:
        unit = units[0] if units else None
        if any("down" in map(str.lower, axis.words) for axis in node.all(_AXIS)):
            unit = LengthUnit("units of depth", 0.0)
        return CoordinateSystem(name=name, height=unit, epsg=epsg)
    cartesian = any("cartesian" in map(str.lower, part.words) for part in node.all(frozenset(("CS",))))
    if node.keyword in _DEGREES or (node.keyword in _GEODETIC and not cartesian):
        of_heights = [unit for axis in node.all(_AXIS) for unit in axis.all(frozenset(("LENGTHUNIT",)))]
        height = units[0] if of_heights else None
        return CoordinateSystem(name=name, geographic=True, height=height, epsg=epsg)
    if node.keyword in _PLANE or node.keyword in _GEODETIC:
        height = units[2] if len(units) > 2 else None
        of_plane = units[0] if units else None
        if len({*units[:2]}) > 1:
            of_plane = LengthUnit(" and ".join(unit.name for unit in units[:2]), 0.0)
        return CoordinateSystem(name=name, plane=of_plane, height=height, epsg=epsg)
    return None


def _units(node: _Node) -> list[LengthUnit]:
    """Return the length units of a system's axes: one per axis if axes name theirs, else one for all."""
    of_axes = [unit for axis in node.all(_AXIS) for unit in axis.all(_UNITS)]
    units = []
    for unit in of_axes or node.all(_UNITS):
        try:
            metres = float(unit.words[1])
        except (IndexError, ValueError):
            metres = _by_name(unit.words[0]) if unit.words else 0.0
        units.append(_length(unit.words[0] if unit.words else "", metres))
    return units


def _epsg(node: _Node) -> int:
    for one in node.all(frozenset(("AUTHORITY", "ID"))):
        if len(one.words) > 1 and one.words[0].upper() == "EPSG" and one.words[1].isdigit():
            return int(one.words[1][:9])
    return 0


def _by_name(text: str) -> float:
    """Return the metres of a unit that a text names; 0 if it names none."""
    plain = text.lower().replace("_", " ")
    if re.search(r"us[ -]?(survey )?f(oo|ee)?t|ftus|foot us|feet us|survey f(oo|ee)t", plain):
        return FEET["us-ft"].metres
    if re.search(r"\bf(oo|ee)?t\b|\(ft\)", plain):
        return FEET["ft"].metres
    return 1.0 if re.search(r"\bmet(re|er)s?\b|\(m\)", plain) else 0.0


# --- GeoTIFF keys ---------------------------------------------------------------------------------

_MODEL, _CITATION, _GEOG_TYPE, _GEOG_CITATION, _GEOG_UNIT = 1024, 1026, 2048, 2049, 2052
_PROJECTED_TYPE, _PROJECTED_CITATION, _PROJECTED_UNIT, _PROJECTED_UNIT_SIZE = 3072, 3073, 3076, 3077
_VERTICAL_TYPE, _VERTICAL_CITATION, _VERTICAL_UNIT = 4096, 4097, 4099
_GEOGRAPHIC_MODEL: Final = 2
_ASCII_TAG, _DOUBLE_TAG = 34737, 34736
_USER_DEFINED: Final = 32767
_UNIT_CODES: Final = {
    9001: METRE,
    9002: FEET["ft"],
    9003: FEET["us-ft"],
    9005: LengthUnit("Clarke's foot", 0.3047972654),
    9014: LengthUnit("fathom", 1.8288),
    9030: LengthUnit("nautical mile", 1852.0),
    9035: LengthUnit("US survey mile", 5280 * 1200 / 3937),
    9036: LengthUnit("kilometre", 1000.0),
    9093: LengthUnit("statute mile", 1609.344),
    9095: LengthUnit("British foot", 0.3048007491),
    1025: LENGTHS["mm"],
    1033: LENGTHS["cm"],
}
# US state planes, whose unit follows from the code: NAD27, NAD83, NAD83(HARN)
_STATE_PLANES: Final = (range(2222, 2290), range(2867, 2931), range(32001, 32059))
_STATE_PLANES_FT: Final = frozenset[int]().union(
    range(2222, 2225),
    range(2251, 2254),
    (2256, 2265, 2266, 2269, 2270, 2273),
    range(2280, 2283),
    range(2867, 2870),
    range(2896, 2899),
    (2901, 2909, 2910, 2913, 2914),
    range(2921, 2924),
)


def geokey_system(directory: bytes, doubles: bytes, text: bytes) -> CoordinateSystem | None:
    """Return the system in GeoTIFF keys: directory (34735), doubles (34736) and texts (34737).

    None if there is no valid directory.
    """
    if len(directory) < 8 or len(directory) % 2:
        return None
    shorts = struct.unpack(f"<{len(directory) // 2}H", directory)
    count = min(shorts[3], (len(shorts) - 4) // 4)
    numbers: dict[int, float] = {}
    texts: dict[int, str] = {}
    for key in range(count):
        number, tag, length, value = shorts[4 + 4 * key : 8 + 4 * key]
        if tag == 0:
            numbers[number] = value
        elif tag == _DOUBLE_TAG and 8 * value + 8 <= len(doubles):
            (numbers[number],) = struct.unpack_from("<d", doubles, 8 * value)
        elif tag == _ASCII_TAG:
            texts[number] = text[value : value + length].decode("utf-8", "replace").strip("\0| ")
    geographic = numbers.get(_MODEL) == _GEOGRAPHIC_MODEL
    projected = int(numbers.get(_PROJECTED_TYPE, 0))
    code = projected or (int(numbers.get(_GEOG_TYPE, 0)) if geographic else 0)
    names = [texts.get(key, "") for key in (_PROJECTED_CITATION, _CITATION, _GEOG_CITATION)]
    height = _coded(numbers, _VERTICAL_UNIT)
    if height is None and (metres := _by_name(texts.get(_VERTICAL_CITATION, ""))):
        height = _length(texts[_VERTICAL_CITATION], metres)
    plane = None
    if not geographic:
        plane = _coded(numbers, _PROJECTED_UNIT, _PROJECTED_UNIT_SIZE) or _coded(numbers, _GEOG_UNIT)
    if plane is None and any(projected in codes for codes in _STATE_PLANES):
        plane = _state_plane_unit(projected)
    if plane is None and not geographic and (metres := _by_name(" ".join(names[:2]))):
        plane = _length(names[0] or names[1], metres)
    return CoordinateSystem(
        name=next(filter(None, names if not geographic else names[::-1]), ""),
        geographic=geographic,
        plane=plane,
        height=height,
        epsg=code if code not in (0, _USER_DEFINED) else 0,
    )


def _coded(numbers: dict[int, float], key: int, size_key: int = 0) -> LengthUnit | None:
    code = int(numbers.get(key, 0))
    if code in (0, 9101, 9102):  # degrees and radians: the key is about angles
        return None
    if code == _USER_DEFINED and size_key in numbers:
        return _length("", numbers[size_key])
    return _UNIT_CODES.get(code, LengthUnit(f"unit EPSG:{code}", 0.0))


# --- text --------------------------------------------------------------------------------------------

_WKT_AT: Final = re.compile(
    rf"\b(?:{'|'.join(sorted(_PLANE | _DEGREES | _GEODETIC | _HEIGHT | _COMPOUND | _AROUND))})\s*[\[(]", re.I
)
_PROJ: Final = re.compile(r"\+(proj|units|to_meter|vunits|vto_meter)=([^\s\"'+]+)")
_EPSG_CODE: Final = re.compile(r"\bEPSG[\s:/]+(?:[0-9.]*[:/])?([0-9]{4,5})\b", re.I)
_GEOGRAPHIC_CODES: Final = (4258, 4267, 4269, 4283, 4326, 4490, 4612, 4937, 4979, 6318, 6668, 7844)


def system_in_text(text: str) -> CoordinateSystem | None:
    """Return the system that a comment names, as far as units follow from it: WKT, PROJ or an EPSG code."""
    if found := _WKT_AT.search(text):
        return wkt_system(text[found.start() :])
    if fields := dict(_PROJ.findall(text)):
        plane = _proj_unit(fields.get("to_meter"), fields.get("units"))
        height = _proj_unit(fields.get("vto_meter"), fields.get("vunits"))
        geographic = fields.get("proj") in ("longlat", "latlong", "lonlat", "latlon")
        is_known = geographic or plane is not None or height is not None
        return CoordinateSystem("", geographic, None if geographic else plane, height) if is_known else None
    for code in map(int, _EPSG_CODE.findall(text)):
        if code in _GEOGRAPHIC_CODES or any(code in codes for codes in _STATE_PLANES):
            unit = None if code in _GEOGRAPHIC_CODES else _state_plane_unit(code)
            return CoordinateSystem("", unit is None, unit, epsg=code)
    return None


def _proj_unit(metres: str | None, name: str | None) -> LengthUnit | None:
    if metres is not None:
        over, _, under = metres.partition("/")
        try:
            return _length("", float(over) / float(under or 1))
        except (ValueError, ZeroDivisionError):
            return LengthUnit(metres, 0.0)
    known = {"m": METRE, "km": LengthUnit("kilometre", 1000.0), **LENGTHS}
    return None if name is None else known.get(name, LengthUnit(name, 0.0))


def _state_plane_unit(code: int) -> LengthUnit:
    return FEET["ft" if code in _STATE_PLANES_FT else "us-ft"]


GEOGRAPHIC_SYSTEM: Final = (
    "its coordinate system is geographic: x and y are degrees, not metres; convert it to a metric "
    "system first,"
    " such as UTM"
)

_MAX_DEGREES: Final = 5.0  # span in x and y; larger clouds in degrees are not recognised
_FLATNESS: Final = 20.0  # heights are in metres, so a cloud in degrees seems to be far higher than wide
_OFF_ORIGIN: Final = 1.0  # a small object near the origin may be as slender as such a cloud


def degrees_warning(lowest: NDArray[np.float64], highest: NDArray[np.float64]) -> str:
    """Return a warning if bounds ((3,) each) look like degrees, else an empty text.

    They do if x and y are valid longitudes and latitudes and span few degrees, while heights span many times
    as much: a town is 0.05 degrees wide and 50 m high.
    """
    import numpy as np

    x, y = (max(abs(low), abs(high)) for low, high in zip(lowest[:2], highest[:2], strict=True))
    with np.errstate(over="ignore"):
        spans = highest - lowest
    wide = max(spans[:2])
    possible = x <= 180.0 and y <= 90.0 and max(x, y) > _OFF_ORIGIN and 0.0 < wide <= _MAX_DEGREES
    if not (possible and spans[2] > _FLATNESS * wide and all(map(math.isfinite, spans))):
        return ""
    return (
        f"x and y look like degrees, not metres: x {lowest[0]:.6g} .. {highest[0]:.6g},"
        f" y {lowest[1]:.6g} .. {highest[1]:.6g}; if they are longitude and latitude, convert the cloud to a"
        " metric system first, such as UTM"
    )


def unit_warnings(crs: CoordinateSystem | None) -> tuple[str, ...]:
    """Return warnings about a file's units: degrees, or lengths other than metres."""
    if crs is None:
        return ()
    plane, height = crs.units
    said = [GEOGRAPHIC_SYSTEM] if crs.geographic else []
    if crs.geographic and height != METRE:
        said.append(f"heights are in {unit_text(height)}, not metres")
    elif not crs.geographic and (plane, height) != (METRE, METRE):
        said.append(f"coordinates are not in metres: {units_text(plane, height)}")
    return tuple(said)


def units_text(plane: LengthUnit, height: LengthUnit) -> str:
    """Return text with the units of plane and height, each with its length."""
    if plane == height:
        return f"x, y and z are in {unit_text(plane)}"
    return f"x and y are in {unit_text(plane)}, z in {unit_text(height)}"


def unit_text(unit: LengthUnit) -> str:
    """Return a unit's name with its length."""
    if unit == METRE:
        return "metres"
    name = re.sub(r"\bfoot\b", "feet", unit.name)
    name = re.sub(r"(metre|yard|mile)$", r"\1s", re.sub(r"\binch$", "inches", name))
    return f"{name} ({unit.metres:.12g} m)" if unit.metres else f"{name} (of a length not known)"
