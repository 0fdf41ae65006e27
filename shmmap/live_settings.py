# SPDX-License-Identifier: Apache-2.0
"""Settings of the live maps: ``--live NAME[=DIR]`` and ``[live.NAME]`` of the settings file."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from shmmap.chunks.layout import MAX_FRAME_BYTES
from shmmap.chunks.occupancy import Occupancy
from shmmap.config_table import Allowed, near_hint, rows_of, setting, within
from shmmap.errors import ConfigError

SERVICE_STATE: Final = "/var/lib/shmmap/state"
"""Directory in which each instance of the installed service has its state (StateDirectory= of the units)."""

REAL_S: Final = 0.5

_OCCUPANCY: Final = Occupancy()
_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """Settings of one live map; clients use its ``name``.

    The settings of voxels are fixed when the map is created, see `shmmap.chunks.occupancy.Occupancy`.  For
    what stays in memory, and how long changes exist only there, see
    `shmmap.live_worker.paging.residency.Limits`.
    """

    name: str
    path: str = setting(
        "",
        "directory of its files",
        allowed=Allowed(os.path.isabs, "write the whole path, from / on"),
        unset="live/NAME in the service's or the user's state directory",
    )
    resolution: float = setting(
        0.05,
        "edge of a voxel, metres; this, the frame and the probabilities are fixed when the map is made",
        allowed=within(1e-4, 1e3, "metres"),
    )
    frame_id: str = setting(
        "map",
        "name of the map's frame",
        allowed=Allowed(
            lambda frame: 0 < len(frame.encode()) <= MAX_FRAME_BYTES,
            f"1 to {MAX_FRAME_BYTES} bytes of UTF-8",
        ),
    )
    hit: float = setting(_OCCUPANCY.hit, "what one hit says, a probability above a half")
    miss: float = setting(_OCCUPANCY.miss, "what one miss says, a probability below a half")
    clamp_min: float = setting(
        _OCCUPANCY.clamp_min, "no voxel is surer to be free than this probability says"
    )
    clamp_max: float = setting(
        _OCCUPANCY.clamp_max, "no voxel is surer to be occupied than this probability says"
    )
    occupied_above: float = setting(
        _OCCUPANCY.occupied_above, "voxels above this probability count as occupied"
    )
    free_below: float = setting(_OCCUPANCY.free_below, "voxels below this probability count as free")
    radius: int = setting(
        1,
        "chunks (64 voxels a side) around each client that stay in memory, along each axis",
        allowed=within(0, 16, "chunks"),
    )
    hysteresis: float = setting(
        0.2,
        "how far a client has to be in another chunk until its window follows, as a part of a chunk",
        allowed=within(0.0, 1.0, "as a part of a chunk"),
    )
    linger_s: float = setting(
        2.0,
        "how many seconds after its last change a chunk outside of all windows counts as near",
        allowed=within(0.0, 3600.0, "seconds"),
    )
    checkpoint_s: float = setting(
        10.0,
        "how many seconds, at most, a change is in memory alone: a power cut can take that much",
        allowed=within(0.1, 3600.0, "seconds"),
    )
    most_active: int = setting(
        0,
        "most known voxels of all chunks in memory",
        allowed=within(0, 1 << 40, "voxels"),
        unset="as many as fit",
    )

    @property
    def occupancy(self) -> Occupancy:
        """Return the weights of evidence; raise ConfigError if they are invalid."""
        return Occupancy(
            self.hit, self.miss, self.clamp_min, self.clamp_max, self.occupied_above, self.free_below
        )


LIVE_ROWS: Final = rows_of(LiveSettings)
"""Metadata of the settings of a live map, by name in the table."""


def live_settings(
    flags: Sequence[str], tables: Mapping[str, Any], origin: str = "command line"
) -> tuple[LiveSettings, ...]:
    """Combine the settings of all live maps.

    Parameters
    ----------
    flags
        ``NAME`` or ``NAME=DIR`` each; the table of that name, if present, has the map's other settings.
    tables
        Table ``live`` of the settings file.
    origin
        Origin of the tables, for messages.

    Raises
    ------
    ConfigError
        A name, key or value is invalid.
    """
    if not isinstance(tables, Mapping) or not all(isinstance(table, Mapping) for table in tables.values()):
        raise ConfigError(
            f"{origin}: live must be tables",
            key="live",
            origin=origin,
            hint="write [live.NAME], and below it the settings of that map",
        )
    found = {name: _from_table(name, table, origin) for name, table in tables.items()}
    for flag in flags:
        name, _, path = flag.partition("=")
        base = found.get(name) or LiveSettings(_checked_name(name, "command line"))
        found[name] = replace(base, path=os.path.abspath(path) if path else base.path)
    paths: dict[str, str] = {}
    for one in found.values():
        if one.path and (other := paths.setdefault(_real(one.path), one.name)) != one.name:
            raise ConfigError(
                f"live maps {other} and {one.name} are both in {one.path}",
                key="live",
                origin=origin,
                hint="give each a directory of its own",
            )
    return tuple(found.values())


def _real(path: str) -> str:
    """Return a path without links, if it can be resolved quickly: a directory may hang."""
    found = [os.path.normpath(path)]
    looking = threading.Thread(target=lambda: found.append(os.path.realpath(path)), daemon=True)
    looking.start()
    looking.join(REAL_S)
    return found[-1]


def _checked_name(name: str, origin: str) -> str:
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{origin}: a live map cannot be called {name!r}",
            key="live",
            origin=origin,
            hint="use 1 to 64 letters, digits, '-' or '_'",
        )
    return name


def _from_table(name: str, table: Mapping[str, Any], origin: str) -> LiveSettings:
    known = LiveSettings(_checked_name(name, origin))
    values: dict[str, Any] = {}
    for key, value in table.items():
        where = f"{origin}: live.{name}.{key}"
        if key not in LIVE_ROWS:
            raise ConfigError(
                f"{where}: unknown setting",
                key=f"live.{name}.{key}",
                origin=origin,
                hint=near_hint(key, LIVE_ROWS),
            )
        values[key] = LIVE_ROWS[key].checked(value, where, key=key, origin=origin, as_text=False)
    made = replace(known, **values)
    try:
        _ = made.occupancy
    except ConfigError as error:
        raise ConfigError(
            f"{origin}: live.{name}.{error.key}: {error.message}",
            key=error.key,
            origin=origin,
            hint=error.hint,
        ) from None
    return made


def live_directory(instance: str, name: str, environ: Mapping[str, str] = os.environ) -> str:
    """Return the default directory of a live map: ``live/NAME`` in the state directory.

    Raises
    ------
    ConfigError
        There is no state directory.
    """
    state = state_directory(instance, environ)
    if not state:
        raise ConfigError(
            f"there is no state directory for live map {name}",
            key="live",
            hint=f"name one: --live {name}=DIR",
        )
    return os.path.join(state, "live", name)


def state_directory(instance: str, environ: Mapping[str, str] = os.environ) -> str:
    """Return the directory in which an instance keeps data that must not be lost.

    ``$STATE_DIRECTORY`` (a service), else ``$XDG_STATE_HOME/shmmap/INSTANCE``, by default in the home
    directory; empty if there is none.
    """
    service = environ.get("STATE_DIRECTORY", "").split(":")[0]
    if service:
        return service
    base = environ.get("XDG_STATE_HOME", "")
    if not base.startswith("/"):
        home = environ.get("HOME", "")
        if not home.startswith("/"):
            return ""
        base = os.path.join(home, ".local", "state")
    return os.path.join(base, "shmmap", instance)
