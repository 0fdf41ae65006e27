# SPDX-License-Identifier: Apache-2.0
"""Names of coordinates and their units, in headers of tables and in comments.

A header may name coordinates as ``x``, ``X [mm]``, ``y(ft)``, ``z_m``, ``Easting/cm``, ``Points_m_XYZ:0`` or
``lon (deg)``.  A comment may state a unit for all of them: ``units: mm``, ``coordinates in US survey feet``.
What looks like a unit and is none is reported, not guessed at.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from shmmap.formats.coordinate_system import LENGTHS, METRE, CoordinateSystem, LengthUnit, system_in_text

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
_UNIT: Final = re.compile(r"\s*[\[({<][^\[\](){}<>]*[\])}>]")
_GLUED: Final = re.compile(r"([xyz])([a-zµμ]+)")
_SAID: Final = re.compile(r"^\s*(?:(?:all )?in\s+|units?\s*[:=]\s*)")
_BETWEEN: Final = re.compile(r"\s+in\s+|[\s/_:.\-]+")


def decoded(text: bytes) -> str:
    """Return a header's text, which is UTF-8 or Latin-1."""
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def named_unit(text: str) -> LengthUnit | None:
    """Return the unit that a text is the name of; None if it is none."""
    return _NAMES.get(re.sub(r"[\s_.()\-]+", "", _SAID.sub("", text.lower())))


def split_names(text: str) -> list[str]:
    """Return the words of a line of names; units in brackets may have spaces in and before them."""
    joined = _UNIT.sub(lambda found: re.sub(r"[\s,;]+", "", found.group()), text)
    return re.split(r"[\s,;]+", joined.strip())


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
        # of several brackets, as in `X(East) [m]`, one may be a unit
        parts = [inner, *re.split(r"[\[\](){}<>]+", inner)]
        unit = next((unit for part in parts if (unit := named_unit(part) or _multiple_of(part))), None)
        return [_Name(way.base, unit or way.unit, "" if unit else inner) for way in _taken_apart(base)]
    ways = [_Name(_common(text), None)]
    for between in _BETWEEN.finditer(text):
        if unit := named_unit(text[between.end() :]):
            ways.append(_Name(_common(text[: between.start()]), unit))
            break
    if (glued := _GLUED.fullmatch(text)) and (unit := named_unit(glued.group(2))):
        ways.append(_Name(glued.group(1), unit))
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

_HEIGHT: Final = r"z|heights?|elevations?|altitudes?|vertical"
_QUANTITY: Final = (
    r"(?:(?:the|all|of|for|linear|length|distance|measurements?|measure|map|file|data|world|scale|xyz|horizontal"
    r"|values?|dimensions?|coordinates?|coords?|points?|positions?|vert(?:ex|ices)|(?:point[\s_]*)?clouds?|scans?"
    rf"|x[ ,]*y[ ,]*(?:and )?z|{_HEIGHT})(?![a-z])[\s_\-]*|(?:length|linear|distance|coordinate)(?=unit))"
)
_VERB: Final = r"(?:(?:are|is|all|used|given|stored|saved|written|exported|measured|expressed|recorded)\s+)*"
_OPEN: Final = r"[\s:=,>\[(\"']*"
_UNIT_WORD: Final = r"(?:units?|(?:ma(?:ß|ss))?einheit(?:en)?|unit[ée]s?|unidad(?:es)?)"
_BY_UNIT: Final = re.compile(
    rf"\W*(?:1\s+)?(?P<what>{_QUANTITY}*)(?:in\s+)?{_UNIT_WORD}[\s_\-]*(?:of\s+)?{_QUANTITY}*{_VERB}(?:in\s+)?"
    rf"{_OPEN}(?P<unit>.*)"
)
_BY_IN: Final = re.compile(rf"\W*(?P<what>{_QUANTITY}*){_VERB}(?:(?:in|as)\b|[\[(])[\s:]*(?P<unit>.*)")
_BY_DATUM: Final = re.compile(
    r"\W*(?P<what>vertical)\s+(?:datum|reference|crs)\b.*?(?P<unit>\([^()]*\)|[^\s,(]+)$"
)
_BY_COLON: Final = re.compile(rf"\W*(?P<what>{_QUANTITY}+){_VERB}{_OPEN}(?P<unit>.*)")
_UNIT_WORDS: Final = re.compile(r"[a-zµμ\"'°]+(?:[ _\-(]+[a-z]+){0,3}")
_NUMBER_TEXT: Final = r"[0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?"
_NUMBER: Final = re.compile(rf"({_NUMBER_TEXT})\s*(?=[a-zµμ])")
_PER_UNIT: Final = re.compile(
    rf"\W*(?:met(?:re|er)s?[\s_\-]*per[\s_\-]*unit\W*(?P<metres>{_NUMBER_TEXT})"
    rf"|units?[\s_\-]*per[\s_\-]*met(?:re|er)\W*(?P<units>{_NUMBER_TEXT}))\W*$"
)
_SCALE: Final = re.compile(
    rf"\W*(?:(?:global|coordinates?|units?|xyz|[xyz])[\s_\-]*)?scal(?:e|ing)(?:[\s_\-]*(?:factor|xyz|[xyz]))?"
    rf"[\s:=\[(]+(?P<scale>{_NUMBER_TEXT})"
    rf"|.*\b(?:scaled|multiplied|divided)\s+by\s+(?P<by>{_NUMBER_TEXT})"
)
_CLOSING: Final = " .;:!\"'()[]{}<>"

Units: TypeAlias = tuple[LengthUnit, LengthUnit] | None


def units_in_comments(comments: Iterable[str]) -> tuple[LengthUnit | None, LengthUnit | None]:
    """Return the units that comments state for the plane and for heights.

    Comments that contradict each other give a unit of unknown length.
    """
    stated: tuple[list[LengthUnit], list[LengthUnit]] = ([], [])
    for text in comments:
        if system := system_in_text(text):
            plane, height = system.units
            stated[0].append(DEGREE if system.geographic else plane)
            stated[1].append(height)
            continue
        named = coordinates_of(split_names(text))
        if named and named.crs and not named.crs.geographic and _UNSTATED not in named.crs.units:
            for units, unit in zip(stated, named.crs.units, strict=True):
                units.append(unit)
        for clause in dict.fromkeys((text, *re.split(r"[,;.]\s", text))):
            for what, plane, height in _stated_by(clause.lower(), whole=clause is text):
                is_height = re.search(rf"(?<![a-z])(?:{_HEIGHT})(?![a-z])", what)
                if not is_height or re.search(r"x[ ,]*y", what):
                    stated[0].append(plane)
                if "horizontal" not in what:
                    stated[1].append(height)
    return _only(stated[0]), _only(stated[1])


def _stated_by(clause: str, *, whole: bool) -> Iterator[tuple[str, LengthUnit, LengthUnit]]:
    """Yield what a clause is about, and the units of plane and height that it states."""
    if (found := _BY_DATUM.match(clause)) and (unit := _whole_unit(found["unit"])):
        yield found["what"], unit, unit
    elif found := _PER_UNIT.match(clause):
        metres = float(found["metres"] or 0.0) or 1.0 / float(found["units"] or 0.0)
        unit = METRE if metres == 1.0 else LengthUnit(f"units of {metres:g} metre", metres)
        yield "", unit, unit
    elif found := _BY_UNIT.match(clause):
        if units := _three(found["unit"]) or _twice(
            _multiple_of(found["unit"]) or _first_unit(found["unit"])
        ):
            yield found["what"], *units
    elif (found := _BY_IN.match(clause)) and (units := _twice(_first_unit(found["unit"]))):
        yield found["what"], *units
    elif (found := _BY_COLON.match(clause)) and (unit := _whole_unit(found["unit"])):
        yield found["what"], unit, unit
    elif whole and (unit := _whole_unit(clause)):
        yield "", unit, unit


def _whole_unit(text: str) -> LengthUnit | None:
    """Return the unit that a text is, and nothing else."""
    return named_unit(text.strip(_CLOSING))


def _three(text: str) -> Units:
    """Return the units of plane and height from three, one for each axis."""
    axes = [unit for word in re.split(r"[\s,;]+", text.strip(_CLOSING)) if (unit := _whole_unit(word))]
    return (axes[0] if axes[0] == axes[1] else _UNSTATED, axes[2]) if len(axes) == 3 else None


def _multiple_of(text: str) -> LengthUnit | None:
    """Return the unit that is a number of another."""
    number = _NUMBER.match(text)
    unit = _whole_unit(text[number.end() :]) if number else None
    if number is None or unit is None or not unit.metres:
        return None
    factor = float(number.group(1))
    return unit if factor == 1 else LengthUnit(f"units of {factor:g} {unit.name}", factor * unit.metres)


def _twice(unit: LengthUnit | None) -> Units:
    """Return a unit for plane and height."""
    return (unit, unit) if unit else None


def _first_unit(text: str) -> LengthUnit | None:
    """Return the unit that a text begins with."""
    found = _UNIT_WORDS.match(text)
    words = re.split(r"[ _\-(]+", found.group()) if found else []
    for end in range(len(words), 0, -1):
        joined = "".join(words[:end])
        if unit := named_unit(joined) or named_unit(joined.rstrip("\"'")):
            return unit
    return None


def _only(units: Sequence[LengthUnit]) -> LengthUnit | None:
    different = list(dict.fromkeys(units))
    if len(different) > 1:
        return LengthUnit(f"{' or '.join(unit.name for unit in different)}, as comments say", 0.0)
    return different[0] if different else None


def system_of_comments(comments: Iterable[str]) -> CoordinateSystem | None:
    """Return the units that comments state, as the units of a coordinate system; None if they state none."""
    plane, height = units_in_comments(comments)
    return _system(plane, plane, height) if plane or height else None


def scale_notes(comments: Iterable[str]) -> tuple[str, ...]:
    """Return notes of scales that comments state; whether to multiply or to divide is not known."""
    notes: dict[str, None] = {}
    for text in comments:
        for clause in (text, *re.split(r"[,;.]\s", text)):
            found = _SCALE.match(clause.lower())
            scale = found["scale"] or found["by"] if found else "1"
            if float(scale) != 1.0:
                notes[f"a comment states a scale of {scale}, which is not applied"] = None
    return tuple(notes)
