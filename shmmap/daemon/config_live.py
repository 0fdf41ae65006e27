# SPDX-License-Identifier: Apache-2.0
"""Which live maps the daemon keeps: ``--live NAME[=DIR]`` and ``[live.NAME]`` of the settings file."""

from __future__ import annotations

import difflib
import os
import re
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Final

import msgspec

from shmmap.chunks.layout import MOST_FRAME_BYTES
from shmmap.chunks.occupancy import Occupancy
from shmmap.daemon.config_file import KINDS
from shmmap.errors import ConfigError

__all__ = ["SERVICE_STATE", "LiveSettings", "live_directory", "live_settings", "state_directory"]

SERVICE_STATE: Final = "/var/lib/shmmap/state"
"""Where each instance of the installed service has its state directory (StateDirectory= of the units)."""

REAL_S: Final = 0.5

_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_RANGES: Final = {
    "resolution": (1e-4, 1e3, "metres"),
    "radius": (0, 16, "chunks"),
    "hysteresis": (0.0, 1.0, "a part of a chunk, up to 1"),
    "linger_s": (0.0, 3600.0, "seconds"),
    "checkpoint_s": (0.1, 3600.0, "seconds"),
    "most_active": (0, 1 << 40, "voxels; 0: as many as fit"),
}
_LARGEST: Final = 1 << 53
"""Beyond any limit; a whole number may be too large for a float."""


class LiveSettings(msgspec.Struct, frozen=True):
    """Settings of one live map.

    Attributes
    ----------
    name
        What clients call it.
    path
        Its directory; empty: the state directory's ``live/NAME``.
    resolution, frame_id, hit, miss, clamp_min, clamp_max, occupied_above, free_below
        Fixed when the map is made, see `shmmap.chunks.occupancy.Occupancy`.
    radius, hysteresis, linger_s, checkpoint_s, most_active
        What stays in memory, and for how long changes are there alone, see
        `shmmap.daemon.live.paging.records.Limits`.
    """

    name: str
    path: str = ""
    resolution: float = 0.05
    frame_id: str = "map"
    hit: float = 0.7
    miss: float = 0.4
    clamp_min: float = 0.12
    clamp_max: float = 0.97
    occupied_above: float = 0.5
    free_below: float = 0.5
    radius: int = 1
    hysteresis: float = 0.2
    linger_s: float = 2.0
    checkpoint_s: float = 10.0
    most_active: int = 0

    @property
    def occupancy(self) -> Occupancy:
        """What evidence is worth; raises ConfigError where that cannot be."""
        return Occupancy(
            self.hit, self.miss, self.clamp_min, self.clamp_max, self.occupied_above, self.free_below
        )


def live_settings(
    flags: Sequence[str], tables: Mapping[str, Any], origin: str = "command line"
) -> tuple[LiveSettings, ...]:
    """Put the settings of all live maps together.

    Parameters
    ----------
    flags
        ``NAME`` or ``NAME=DIR`` each; such a map has the settings of the table of its name, if there is one.
    tables
        ``live`` of the settings file.
    origin
        Where the tables are, for messages.

    Raises
    ------
    ConfigError
        A name, a key or a value cannot be.
    """
    if not isinstance(tables, Mapping) or not all(isinstance(table, Mapping) for table in tables.values()):
        raise ConfigError(
            f"{origin}: live must be tables", key="live", origin=origin,
            hint="write [live.NAME], and below it the settings of that map",
        )  # fmt: skip
    found = {name: _from_table(name, table, origin) for name, table in tables.items()}
    for flag in flags:
        name, _, path = flag.partition("=")
        base = found.get(name) or LiveSettings(_checked_name(name, "command line"))
        found[name] = msgspec.structs.replace(base, path=os.path.abspath(path) if path else base.path)
    paths: dict[str, str] = {}
    for one in found.values():
        if one.path and (other := paths.setdefault(_real(one.path), one.name)) != one.name:
            raise ConfigError(
                f"live maps {other} and {one.name} are both in {one.path}", key="live", origin=origin,
                hint="give each a directory of its own",
            )  # fmt: skip
    return tuple(found.values())


def _real(path: str) -> str:
    """A path without links, as far as that is known at once: a directory may hang."""
    found = [os.path.normpath(path)]
    looking = threading.Thread(target=lambda: found.append(os.path.realpath(path)), daemon=True)
    looking.start()
    looking.join(REAL_S)
    return found[-1]


def _checked_name(name: str, origin: str) -> str:
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{origin}: a live map cannot be called {name!r}", key="live", origin=origin,
            hint="use 1 to 64 letters, digits, '-' or '_'",
        )  # fmt: skip
    return name


def _from_table(name: str, table: Mapping[str, Any], origin: str) -> LiveSettings:
    known = LiveSettings(_checked_name(name, origin))
    values: dict[str, Any] = {}
    for key, value in table.items():
        where = f"{origin}: live.{name}.{key}"
        if key == "name" or key not in known.__struct_fields__:
            names = [field for field in known.__struct_fields__ if field != "name"]
            near = difflib.get_close_matches(key, names, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"settings are: {', '.join(names)}"
            raise ConfigError(f"{where}: unknown setting", key=f"live.{name}.{key}", origin=origin, hint=hint)
        values[key] = _checked(key, value, getattr(known, key), where, origin)
    made = msgspec.structs.replace(known, **values)
    try:
        _ = made.occupancy
    except ConfigError as error:
        raise ConfigError(
            f"{origin}: live.{name}.{error.key}: {error.message}", key=error.key, origin=origin,
            hint=error.hint,
        ) from None  # fmt: skip
    return made


def _checked(key: str, value: Any, default: Any, where: str, origin: str) -> Any:
    kind = type(default)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(max(-_LARGEST, min(value, _LARGEST)))
    if not isinstance(value, kind) or isinstance(value, bool):
        raise ConfigError(
            f"{where} must be {KINDS[kind]}, not {value!r}", key=key, origin=origin,
            hint=f"its default is {default!r}" if default != "" else "write it in quotes",
        )  # fmt: skip
    if key == "frame_id" and not 0 < len(value.encode()) <= MOST_FRAME_BYTES:
        raise ConfigError(
            f"{where} cannot be {value!r}", key=key, origin=origin,
            hint=f"1 to {MOST_FRAME_BYTES} bytes of UTF-8",
        )  # fmt: skip
    if key == "path" and value and not os.path.isabs(value):
        raise ConfigError(
            f"{where} cannot be {value!r}", key=key, origin=origin, hint="write the whole path, from / on"
        )
    if key in _RANGES:
        least, most, what = _RANGES[key]
        if not least <= value <= most:
            raise ConfigError(
                f"{where} cannot be {value!r}", key=key, origin=origin, hint=f"{least} to {most} {what}"
            )
    return value


def live_directory(instance: str, name: str, environ: Mapping[str, str] = os.environ) -> str:
    """Return where a live map is kept whose directory nobody named.

    It is ``live/NAME`` in the state directory.

    Raises
    ------
    ConfigError
        There is none.
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
    """Return where an instance keeps what must not be lost.

    ``$STATE_DIRECTORY`` (a service), else ``$XDG_STATE_HOME/shmmap/INSTANCE``, by default in the home
    directory; empty where there is none.
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
