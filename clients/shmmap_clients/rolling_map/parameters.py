# SPDX-License-Identifier: Apache-2.0
"""Parameters of Rolling-Bonxai, version 1, and the equivalent section of the daemon's settings.

Its parameter file is read unchanged. Omitted parameters have the values of the file in Rolling-Bonxai.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

import msgspec

from shmmap import BadRequest
from shmmap.errors import ConfigError
from shmmap.live import LiveMap, Occupancy, ScanFilter
from shmmap_clients.rolling_map.parameter_file import Entry, Value, read_parameter_file

_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_FRAME_BYTES: Final = 40  # bytes of the frame in a chunk's header
_VERSION_2: Final = {
    "frame_id": "map_frame",
    "base_frame_id": "robot_frame",
    "topic_in": "",
    "resolution": "m_resolution",
    "occupancy_min_z": "s_min_z",
    "occupancy_max_z": "s_max_z",
    "occupancy_threshold": "",
    "occupancy.resolution": "m_resolution",
    "occupancy.occupancy_min_z": "s_min_z",
    "occupancy.occupancy_max_z": "s_max_z",
    "occupancy.occupancy_threshold": "",
    "sensor_model.max_range": "s_max_range",
    "sensor_model.hit": "s_probability_hit",
    "sensor_model.miss": "s_probability_miss",
    "sensor_model.min": "m_occupancy_min_thresh",
    "sensor_model.max": "m_occupancy_max_thresh",
    "rolling.coordinate_system.chunk_size": "c_chunk_dim",
    "rolling.storage.full_save_folder_path": "c_chunk_folder_path",
    "stats.publish_occupied_voxels": "viz_occupied",
    "stats.enable_stats": "viz_usage",
    "stats.quick_stats": "viz_usage",
}
"""Names in version 1, by name in version 2 (a name without dots is from its non-rolling server)."""
_HERE: Final = {
    "topic_in": "give --scans",
    "occupancy_threshold": "occupied_above in [live.NAME] of the daemon's settings",
    "occupancy.occupancy_threshold": "occupied_above in [live.NAME] of the daemon's settings",
    "rolling.transition_manager.hysteresis_ratio": "hysteresis in [live.NAME] of the daemon's settings",
    "rolling.loading_policy.neighborhood.radius": "radius in [live.NAME] of the daemon's settings",
    "rolling.loading_policy.neighbourhood.radius": "radius in [live.NAME] of the daemon's settings",
}
"""Equivalents here of names in version 2 that version 1 lacks."""
_GROUPS: Final = ("occupancy.", "sensor_model.", "rolling.", "server.", "stats.")
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
"""Known names without effect, with the reason; the last two only for some values."""
_KINDS: Final[Mapping[type, str]] = {bool: "true or false", float: "a number", str: "text"}
_KNOWN: Final[Mapping[str, type]] = {
    **dict.fromkeys(("map_frame", "sensor_frame", "robot_frame", "c_chunk_folder_path"), str),
    **dict.fromkeys(("m_resolution", *_OCCUPANCY, *_FILTER), float),
    **dict.fromkeys(("c_chunk_dim", "c_chunk_neiborhood", "c_chunk_cache_capacity"), float),
    **dict.fromkeys(("use_sor_filter", *_SHOWN), bool),
}


class LiveSettings(msgspec.Struct, frozen=True):
    """A live map's settings for the daemon.

    Attributes
    ----------
    resolution
        Edge of a voxel, metres.
    occupancy
        Weights of a hit and a miss.
    frame_id
        Frame of the map.
    radius, hysteresis
        The window: number of chunks around the vehicle's along each axis, and the depth in another chunk at
        which the window follows, as a fraction of a chunk.  Rolling-Bonxai keeps the 26 neighbours, and
        follows at once.
    path
        Directory of the map's files; empty: the daemon chooses.

    Raises
    ------
    ConfigError
        The resolution is not a positive number, or a text is too long or not printable.
    """

    resolution: float = 0.05
    occupancy: Occupancy = Occupancy()
    frame_id: str = "map"
    radius: int = 1
    hysteresis: float = 0.0
    path: str = ""

    def __post_init__(self) -> None:
        if not 0.0 < self.resolution < math.inf:
            raise ConfigError(
                f"resolution = {self.resolution!r}: need a positive number of metres", key="resolution"
            )
        size = len(self.frame_id.encode("utf-8", "replace"))
        if not self.frame_id or not self.frame_id.isprintable() or size > _FRAME_BYTES:
            raise ConfigError(
                f"frame_id = {self.frame_id!r}: need 1 to {_FRAME_BYTES} bytes of printable text",
                key="frame_id",
            )
        if not self.path.isprintable():
            raise ConfigError(f"path = {self.path!r}: need printable text", key="path")


def live_section(name: str, settings: LiveSettings) -> str:
    """Return the section as TOML; a relative path is made absolute.

    Raises
    ------
    BadRequest
        The name is invalid for a map.
    """
    if not _NAME.fullmatch(name):
        raise BadRequest(f"{name!r} is no name of a map", hint="use letters, digits, _ and -")
    occupancy = settings.occupancy
    lines = [
        f"[live.{name}]",
        f"resolution = {settings.resolution!r}  # metres",
        f"frame_id = {_quoted(settings.frame_id)}",
        *(f"{field} = {getattr(occupancy, field)!r}" for field in occupancy.__struct_fields__),
        f"radius = {settings.radius}  # chunks of 64 voxels around the vehicle's",
        f"hysteresis = {settings.hysteresis!r}  # as a part of a chunk",
    ]
    if settings.path:
        lines.append(f"path = {_quoted(os.path.abspath(settings.path))}")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _version_2_advice(names: Iterable[str]) -> str:
    """Return a hint with the replacements of names of version 2."""
    said = []
    for name in names:
        if _VERSION_2.get(name):
            said.append(f"{_VERSION_2[name]} for {name}")
        else:
            said.append(f"{_HERE[name]} for {name}" if name in _HERE else f"nothing for {name}")
    return "write " + "; ".join(said)


class Shown(NamedTuple):
    """Items that the picture and the progress show; defaults as in the file of Rolling-Bonxai."""

    occupied: bool = True
    free: bool = False
    chunks: bool = True
    usage: bool = False


class Parameters(msgspec.Struct, frozen=True):
    """Contents of a parameter file.

    Attributes
    ----------
    live
        Settings of the daemon's live map.
    scan_filter
        Filter of a scan's points.
    shown
        Items that a picture shows.
    without_effect
        Names in the file that have no effect here, with the reason.
    origins
        ``FILE:LINE`` by name.
    """

    live: LiveSettings = LiveSettings()
    scan_filter: ScanFilter = ScanFilter()
    shown: Shown = Shown()
    without_effect: dict[str, str] = {}
    origins: dict[str, str] = {}

    @property
    def warning(self) -> str:
        """Return one line about all parameters without effect; empty if there are none."""
        if not self.without_effect:
            return ""
        by_reason: dict[str, list[str]] = {}
        for name, reason in self.without_effect.items():
            by_reason.setdefault(reason, []).append(name)
        return "no effect here: " + "; ".join(
            f"{', '.join(names)} ({reason})" for reason, names in by_reason.items()
        )

    def check_map(self, live: LiveMap) -> None:
        """Raise if a live map differs from the file, ignoring parameters that the file omits.

        Raises
        ------
        ConfigError
            The map differs from the file.
        """
        has: dict[str, float | str] = {"m_resolution": live.resolution, "map_frame": live.frame_id}
        wants: dict[str, float | str] = {
            "m_resolution": self.live.resolution,
            "map_frame": self.live.frame_id,
        }
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
                    hint="`shmmap-rolling config` says how the daemon makes a map as in the file",
                )


def read_parameters(path: str | os.PathLike[str]) -> Parameters:
    """Read a parameter file of Rolling-Bonxai, version 1.

    Raises
    ------
    MapMissing
        There is no such file.
    ConfigError
        The file is not a parameter file; a name is unknown or from version 2; or a value is invalid.
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
    """Raise if a name is unknown in version 1."""
    strange = [name for name in entries if name not in _KNOWN]
    if not strange:
        return
    foreign = [name for name in strange if name in _VERSION_2 or name.startswith(_GROUPS)]
    if foreign:
        name, origin = foreign[0], entries[foreign[0]].origin
        same = f", which version 1 calls {_VERSION_2[name]}" if _VERSION_2.get(name) else ""
        raise ConfigError(
            f"{origin}: {name} is a name of Rolling-Bonxai's version 2{same}",
            key=name,
            origin=origin,
            hint=_version_2_advice(foreign),
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
    kind: Any,
    names: Mapping[str, str],
    values: Mapping[str, Value],
    entries: Mapping[str, Entry],
    **others: Any,
) -> Any:
    """Convert the values to a structure; errors have the name and line of the value in the file."""
    given = {ours: values[name] for name, ours in names.items() if name in values}
    try:
        return kind(**given, **others)
    except ConfigError as error:
        name = next((name for name, ours in names.items() if ours == error.key), "")
        # of two contradicting values the struct names the upper; the file may have only the lower
        entry = entries.get(name) or next(entries[name] for name in names if name in entries)
        said = error.message
        for theirs, ours in names.items():
            said = said.replace(f"{ours} = ", f"{theirs} = ")
        raise ConfigError(f"{entry.origin}: {said}", key=name, origin=entry.origin) from None
