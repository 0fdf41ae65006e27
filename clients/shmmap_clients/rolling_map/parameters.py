# SPDX-License-Identifier: Apache-2.0
"""The parameters of Rolling-Bonxai, version 1: its parameter file is read as it is.

What a file leaves out is as in the file that Rolling-Bonxai ships.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import msgspec

from shmmap import ConfigError, LiveMap, Occupancy, ScanFilter
from shmmap_clients.rolling_map.foreign_names import VERSION_2, is_version_2, version_2_advice
from shmmap_clients.rolling_map.live_section import LiveSettings
from shmmap_clients.rolling_map.parameter_file import Entry, Value, read_parameter_file

__all__ = ["Parameters", "Shown", "read_parameters"]

_CHUNK_DIM: Final = 64

_LIVE: Final = {"m_resolution": "resolution", "map_frame": "frame_id", "c_chunk_folder_path": "path"}
_OCCUPANCY: Final = {
    "m_occupancy_min_thresh": "clamp_min",
    "m_occupancy_max_thresh": "clamp_max",
    "s_probability_hit": "hit",
    "s_probability_miss": "miss",
}
_FILTER: Final = {
    "s_min_range": "min_range",
    "s_max_range": "max_range",
    "s_min_z": "min_z",
    "s_max_z": "max_z",
}
_SHOWN: Final = {f"viz_{name}": name for name in ("occupied", "free", "chunks", "usage")}

_WITHOUT_MEANING: Final = {
    "sensor_frame": "scans come with the poses of their frame",
    "robot_frame": "scans come with the poses of their frame",
    "c_chunk_neiborhood": "Rolling-Bonxai does not use it either",
    "c_chunk_cache_capacity": "Rolling-Bonxai does not use it either",
    "c_chunk_dim": "chunks have 64 voxels along each edge",
    "use_sor_filter": "scans are not searched for outliers",
}
"""Names that are known and change nothing, and why; the last two only with some values."""

_KINDS: Final[Mapping[type, str]] = {bool: "true or false", float: "a number", str: "text"}
_KNOWN: Final[Mapping[str, type]] = {
    **dict.fromkeys(("map_frame", "sensor_frame", "robot_frame", "c_chunk_folder_path"), str),
    **dict.fromkeys(("m_resolution", *_OCCUPANCY, *_FILTER), float),
    **dict.fromkeys(("c_chunk_dim", "c_chunk_neiborhood", "c_chunk_cache_capacity"), float),
    **dict.fromkeys(("use_sor_filter", *_SHOWN), bool),
}


class Shown(NamedTuple):
    """What a picture and the lines of progress show; the defaults are those of the file that is shipped."""

    occupied: bool = True
    free: bool = False
    chunks: bool = True
    usage: bool = False


class Parameters(msgspec.Struct, frozen=True):
    """What a parameter file says.

    Attributes
    ----------
    live
        Of the map, which the daemon has: see `LiveSettings`.
    scan_filter
        Which points of a scan count.
    shown
        What a picture shows.
    without_effect
        Names in the file that change nothing here, and why.
    origins
        By name, ``FILE:LINE``.
    """

    live: LiveSettings = LiveSettings()
    scan_filter: ScanFilter = ScanFilter()
    shown: Shown = Shown()
    without_effect: dict[str, str] = {}
    origins: dict[str, str] = {}

    @property
    def warning(self) -> str:
        """One line about all that has no effect; empty where everything has."""
        if not self.without_effect:
            return ""
        by_reason: dict[str, list[str]] = {}
        for name, reason in self.without_effect.items():
            by_reason.setdefault(reason, []).append(name)
        return "no effect here: " + "; ".join(
            f"{', '.join(names)} ({reason})" for reason, names in by_reason.items()
        )

    def check_map(self, live: LiveMap) -> None:
        """Refuse a live map that is not as the file has it; what the file leaves out may be anything.

        Raises
        ------
        ConfigError
            It differs.
        """
        has: dict[str, float | str] = {"m_resolution": live.resolution, "map_frame": live.frame_id}
        wants: dict[str, float | str] = {
            "m_resolution": self.live.resolution, "map_frame": self.live.frame_id,
        }  # fmt: skip
        for theirs, ours in _OCCUPANCY.items():
            wants[theirs] = getattr(self.live.occupancy, ours)
            has[theirs] = getattr(live.occupancy, ours)
        for key, value in wants.items():
            if key in self.origins and has[key] != value:
                origin = self.origins[key]
                raise ConfigError(
                    f"{origin}: {key} is {value}, but the live map {live.name} has {has[key]}",
                    key=key,
                    origin=origin,
                    hint="`shmmap-rolling config` says how the daemon makes a map as the file has it",
                )


def read_parameters(path: str | os.PathLike[str]) -> Parameters:
    """Read a parameter file of Rolling-Bonxai, version 1.

    Raises
    ------
    MapMissing
        There is no such file.
    ConfigError
        It is no such file; a name is unknown, or one of version 2; a value is impossible.
    """
    entries = read_parameter_file(path)
    _check_names(entries)
    values: dict[str, Value] = {}
    without_effect = {}
    for name, entry in entries.items():
        values[name] = _checked(name, entry)
        if name in _WITHOUT_MEANING and (name, values[name]) not in (
            ("c_chunk_dim", _CHUNK_DIM),
            ("use_sor_filter", False),
        ):
            shown = f"{name}: {entry.text}" if name in ("c_chunk_dim", "use_sor_filter") else name
            without_effect[shown] = _WITHOUT_MEANING[name]
    occupancy = _made(Occupancy, _OCCUPANCY, values, entries)
    origins = {name: entry.origin for name, entry in entries.items()}
    return Parameters(
        _made(LiveSettings, _LIVE, values, entries, occupancy=occupancy),
        _made(ScanFilter, _FILTER, values, entries),
        Shown(**{ours: bool(values[name]) for name, ours in _SHOWN.items() if name in values}),
        without_effect,
        origins,
    )


def _check_names(entries: Mapping[str, Entry]) -> None:
    """Refuse what version 1 does not know."""
    strange = [name for name in entries if name not in _KNOWN]
    if not strange:
        return
    foreign = [name for name in strange if is_version_2(name)]
    if foreign:
        name, origin = foreign[0], entries[foreign[0]].origin
        same = f", which version 1 calls {VERSION_2[name]}" if VERSION_2.get(name) else ""
        raise ConfigError(
            f"{origin}: {name} is a name of Rolling-Bonxai's version 2{same}",
            key=name,
            origin=origin,
            hint=version_2_advice(foreign),
        )
    name, origin = strange[0], entries[strange[0]].origin
    near = difflib.get_close_matches(name, _KNOWN, n=1, cutoff=0.0)
    raise ConfigError(
        f"{origin}: Rolling-Bonxai has no parameter {name}",
        key=name,
        origin=origin,
        hint=f"the nearest is {near[0]}",
    )


def _checked(name: str, entry: Entry) -> Value:
    kind = _KNOWN[name]
    if not isinstance(entry.value, kind):
        raise ConfigError(
            f"{entry.origin}: {name}: need {_KINDS[kind]}, not {entry.text or 'a list or nothing'}",
            key=name,
            origin=entry.origin,
        )
    return entry.value


def _made(
    kind: Any, names: Mapping[str, str], values: Mapping[str, Value], entries: Mapping[str, Entry],
    **others: Any,
) -> Any:  # fmt: skip
    """Make a structure of the values; what it refuses is told with the file's name for it, and the line."""
    given = {ours: values[name] for name, ours in names.items() if name in values}
    try:
        return kind(**given, **others)
    except ConfigError as error:
        name = next((name for name, ours in names.items() if ours == error.key), "")
        # the struct names the upper of two that contradict each other; the file may have the other alone
        entry = entries.get(name) or next(entries[name] for name in names if name in entries)
        said = error.message
        for theirs, ours in names.items():
            said = said.replace(f"{ours} = ", f"{theirs} = ")
        raise ConfigError(f"{entry.origin}: {said}", key=name, origin=entry.origin) from None
