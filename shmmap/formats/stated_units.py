# SPDX-License-Identifier: Apache-2.0
"""Names of coordinates and their units, in headers of tables and in comments.

A header may name coordinates as ``x``, ``X [mm]``, ``y(ft)``, ``z_m``, ``Easting/cm``, ``Points_m_XYZ:0`` or
``lon (deg)``.  A comment may state a unit for all of them: ``units: mm``, ``coordinates in US survey feet``.
What looks like a unit and is none is reported, not guessed at.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from shmmap.formats.coordinate_system import LENGTHS, METRE, CoordinateSystem, LengthUnit

__all__ = [
    "Coordinates",
    "coordinates_of",
    "decoded",
    "named_unit",
    "system_of_comments",
    "units_in_comments",
    "units_row",
]

DEGREE: Final = LengthUnit("degree", 0.0)
_UNSTATED: Final = LengthUnit("a unit that the header does not state", 0.0)

_US: Final = LENGTHS["us-ft"]
_NAMES: Final[dict[str, LengthUnit]] = {
    **dict.fromkeys(("m", "mtr", "mtrs"), METRE),
    **dict.fromkeys(("um", "µm", "μm", "micron", "microns"), LengthUnit("micrometre", 1e-6)),
    "dm": LengthUnit("decimetre", 0.1),
    "km": LengthUnit("kilometre", 1000.0),
    "mm": LENGTHS["mm"],
    "cm": LENGTHS["cm"],
    **dict.fromkeys(("in", "inch", "inches", '"', "″"), LENGTHS["in"]),
    **dict.fromkeys(("ft", "foot", "feet", "'", "′", "ift", "intft"), LENGTHS["ft"]),
    **dict.fromkeys(("internationalfoot", "internationalfeet"), LENGTHS["ft"]),
    **dict.fromkeys(("yd", "yds", "yard", "yards"), LengthUnit("yard", 0.9144)),
    **dict.fromkeys(("mi", "mile", "miles"), LengthUnit("mile", 1609.344)),
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°", "º", "decimaldegrees", "dd"), DEGREE),
    **dict.fromkeys(("rad", "radian", "radians"), DEGREE),
    **{
        f"{prefix}{name}": LengthUnit(f"{prefix}metre", factor)
        for prefix, factor in (("nano", 1e-9), ("micro", 1e-6), ("deci", 0.1), ("kilo", 1000.0))
        for name in ("metre", "metres", "meter", "meters")
    },
    **{
        f"{prefix}{name}": unit
        for prefix, unit in (("", METRE), ("milli", LENGTHS["mm"]), ("centi", LENGTHS["cm"]))
        for name in ("metre", "metres", "meter", "meters")
    },
    **{
        f"{left}{name}{right}": _US
        for left, right in (("us", ""), ("ussurvey", ""), ("survey", ""), ("", "us"), ("", "ussurvey"))
        for name in ("ft", "foot", "feet")
    },
    "sft": _US,
}
_BRACKET: Final = re.compile(r"(.*?[^\s])\s*[\[({<](.*?)[\])}>]?$")
_BETWEEN: Final = re.compile(r"\s+in\s+|[\s/_:.\-]+")


def decoded(text: bytes) -> str:
    """Return a header's text, which is UTF-8 or Latin-1."""
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def named_unit(text: str) -> LengthUnit | None:
    """Return the unit that a text is the name of; None if it is none."""
    return _NAMES.get(re.sub(r"[\s_.()\-]+", "", text.lower().removeprefix("in ")))


# --- names of columns -----------------------------------------------------------------------------------

_PLANES: Final = (
    (("x",), ("y",)),
    (("easting", "eastings", "east", "e"), ("northing", "northings", "north", "n")),
)
_HEIGHTS: Final = ("elevation", "elev", "ele", "height", "altitude", "alt", "h", "up", "u")
_DEGREES: Final = (("lon", "long", "lng", "longitude"), ("lat", "latitude"))
_COORDINATE: Final = r"(?:coordinates?|coords?|positions?|pos)?"
_AXIS: Final = re.compile(rf"{_COORDINATE}([xyz]){_COORDINATE}|([a-z]+?)(?:coordinates?|coords?)")
_NUMBERED: Final = re.compile(r"(?:points?|coords?|coordinates?|positions?|xyz)(?:([a-zµμ]+)xyz)?([012xyz])")


@dataclass(frozen=True, slots=True)
class Coordinates:
    """What a header says about coordinates.

    Attributes
    ----------
    places
        Columns of x, y and z.
    crs
        Their units, and whether x and y are degrees; None if the header says nothing about either.
    problem
        Why they cannot be used; empty if they can.
    notes
        What looks like a unit, and is not known as one.
    """

    places: tuple[int, int, int]
    crs: CoordinateSystem | None
    problem: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Name:
    """A column's name without its unit, both in a common form."""

    base: str
    unit: LengthUnit | None
    unknown: str = ""


def _taken_apart(name: str) -> list[_Name]:
    """Return the ways in which a name can be read: as it is, and with its end as a unit."""
    text = name.strip().strip("\"'").strip().lower()
    if found := _BRACKET.fullmatch(text):
        base, inner = found.groups()
        unit = named_unit(inner)
        return [_Name(way.base, unit or way.unit, "" if unit else inner) for way in _taken_apart(base)]
    ways = [_Name(_common(text), None)]
    for between in _BETWEEN.finditer(text):
        if unit := named_unit(text[between.end() :]):
            ways.append(_Name(_common(text[: between.start()]), unit))
            break
    return ways


def _common(text: str) -> str:
    """Return a name as the tables here have it."""
    plain = re.sub(r"[\s_:.\-/]+", "", text)
    found = _AXIS.fullmatch(plain)
    return (found.group(1) or found.group(2)) if found else plain


def coordinates_of(
    names: Sequence[str],
    units: Sequence[LengthUnit | None] = (),
    stated: tuple[LengthUnit | None, LengthUnit | None] = (None, None),
) -> Coordinates | None:
    """Return which columns are x, y and z, and their units; None if the names do not say so once each.

    For names without a unit, ``units`` are those of a line of units, ``stated`` those of plane and height.
    """
    read = [_taken_apart(name) for name in names]
    degrees = [_place(read, family) for family in (*_DEGREES, ("z", *_HEIGHTS))]
    planes = [[_place(read, family) for family in plane] for plane in _PLANES]
    known = [plane for plane in planes if None not in plane]
    for found in (
        [*planes[0], _place(read, ("z",))],
        [*known[0], _place(read, ("z",)) or _place(read, _HEIGHTS)] if len(known) == 1 else [None],
        _numbered(names),
        degrees,
    ):
        places = [one for one in found if one is not None]
        if len(places) == 3:
            return _checked(names, places, units, stated, geographic=found is degrees)
    return None


def _place(read: Sequence[Sequence[_Name]], family: Iterable[str]) -> tuple[int, _Name] | None:
    """Return the one column whose name is of a family; names without a unit count first."""
    for way in (0, 1):
        found = [
            (place, ways[way])
            for place, ways in enumerate(read)
            if len(ways) > way and ways[way].base in family
        ]
        if len(found) == 1:
            return found[0]
        if found:
            return None
    return None


def _numbered(names: Sequence[str]) -> list[tuple[int, _Name] | None]:
    """Return the columns of a vector that a table has as ``Points:0``, ``Points_m_XYZ:1``, ``Points_2``."""
    found: dict[str, tuple[int, _Name]] = {}
    for place, name in enumerate(names):
        way = _taken_apart(re.sub(r"[\[(]([012])[\])]\s*$", r":\1", name.strip().strip("\"'")))[0]
        part = _NUMBERED.fullmatch(way.base)
        if part is None or part.group(2) in found:
            continue
        unit = named_unit(part.group(1)) if part.group(1) else way.unit
        found[part.group(2)] = (place, _Name(way.base, unit, "" if unit else part.group(1) or ""))
    for parts in ("012", "xyz"):
        if all(part in found for part in parts):
            return [found[part] for part in parts]
    return [None]


def _checked(
    names: Sequence[str],
    found: Sequence[tuple[int, _Name]],
    row: Sequence[LengthUnit | None],
    stated: tuple[LengthUnit | None, LengthUnit | None],
    *,
    geographic: bool = False,
) -> Coordinates:
    """Return the coordinates with their units, after a check that these go together."""
    x, y, z = (place for place, _ in found)
    units = [name.unit or (row[place] if row else None) for place, name in found]
    notes = tuple(
        f"{names[place].strip()!r} states no unit that is known" for place, name in found if name.unknown
    )
    x_unit, y_unit, z_unit = (unit or stated[axis // 2] for axis, unit in enumerate(units))
    if geographic:
        x_unit = y_unit = DEGREE
    problem = ""
    if x_unit and y_unit and x_unit != y_unit:
        problem = f"{names[x].strip()!r} and {names[y].strip()!r} are in different units"
    elif z_unit is DEGREE and x_unit is not DEGREE:
        problem = f"{names[z].strip()!r} is an angle, not a height"
    if problem or not any((x_unit, y_unit, z_unit)):
        return Coordinates((x, y, z), None, problem, notes)
    return Coordinates((x, y, z), _system(x_unit, y_unit, z_unit), "", notes)


def _system(x: LengthUnit | None, y: LengthUnit | None, z: LengthUnit | None) -> CoordinateSystem:
    """Return a system of these units; what is not stated is metres only if nothing else is stated."""
    rest = METRE if {x, y, z} <= {None, METRE, DEGREE} else _UNSTATED
    if x is DEGREE or y is DEGREE:
        return CoordinateSystem(geographic=True, height=None if z is DEGREE else z or rest)
    plane, height = x if x and y else rest, z or rest
    return CoordinateSystem(plane=plane, height=None if height == plane else height)


def units_row(words: Sequence[str]) -> list[LengthUnit | None] | None:
    """Return the units in a line of units below the names; None if it is no such line."""
    units = [named_unit(word.strip().strip("\"'").strip("[](){}<> ")) for word in words]
    return units if len(list(filter(None, units))) >= 3 else None


# --- comments -------------------------------------------------------------------------------------------

_QUANTITY: Final = (
    r"(?:(?:the|all|of|for|linear|length|distance|measurement|measure|map|file|data|world|scale|xyz|horizontal"
    r"|vertical|values?|dimensions?|coordinates?|coords?|points?|positions?|vert(?:ex|ices)"
    r"|x[ ,]*y[ ,]*(?:and )?z)[\s_]*)"
)
_VERB: Final = r"(?:(?:are|is|all|used|given|stored|measured|expressed|recorded)\s+)*"
_STATED: Final = (
    re.compile(rf"\W*(?P<what>{_QUANTITY}*)units?\s*{_QUANTITY}*{_VERB}(?:in\s+)?[\s:=,\[(\"']*(?P<unit>.*)"),
    re.compile(rf"\W*(?P<what>{_QUANTITY}+){_VERB}(?:in\b|[\[(])[\s:]*(?P<unit>.*)"),
)
_UNIT_WORDS: Final = re.compile(r"[a-zµμ\"'°]+(?:[ _\-]+[a-z]+){0,3}")


def units_in_comments(comments: Iterable[str]) -> tuple[LengthUnit | None, LengthUnit | None]:
    """Return the units that comments state for the plane and for heights.

    Comments that contradict each other give a unit of unknown length.
    """
    stated: tuple[list[LengthUnit], list[LengthUnit]] = ([], [])
    clauses = (clause for text in comments for clause in dict.fromkeys((text, *re.split(r"[,;.]\s", text))))
    for clause, pattern in itertools.product(clauses, _STATED):
        found = pattern.match(clause.lower())
        if found and (unit := _first_unit(found["unit"])):
            if "vertical" not in found["what"]:
                stated[0].append(unit)
            if "horizontal" not in found["what"]:
                stated[1].append(unit)
    return _only(stated[0]), _only(stated[1])


def _first_unit(text: str) -> LengthUnit | None:
    """Return the unit that a text begins with."""
    found = _UNIT_WORDS.match(text)
    words = re.split(r"[ _\-]+", found.group()) if found else []
    return next(
        (unit for end in range(len(words), 0, -1) if (unit := named_unit("".join(words[:end])))), None
    )


def _only(units: Sequence[LengthUnit]) -> LengthUnit | None:
    different = list(dict.fromkeys(units))
    if len(different) > 1:
        return LengthUnit(f"{' or '.join(unit.name for unit in different)}, as comments say", 0.0)
    return different[0] if different else None


def system_of_comments(comments: Iterable[str]) -> CoordinateSystem | None:
    """Return the units that comments state, as the units of a coordinate system; None if they state none."""
    plane, height = units_in_comments(comments)
    return _system(plane, plane, height) if plane or height else None
