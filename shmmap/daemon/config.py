# SPDX-License-Identifier: Apache-2.0
"""The daemon's settings: defaults, then one TOML file, then ``SHMMAP_*`` variables, then flags."""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

from shmmap.daemon.config_file import KINDS, Setting, read_settings_file
from shmmap.daemon.config_live import LiveSettings, live_settings
from shmmap.errors import BadRequest, ConfigError
from shmmap.formats.coordinate_system import UNITS
from shmmap.protocol.endpoint import (
    DEFAULT_INSTANCE,
    EVENTS_LONGER,
    SYSTEM_RUNTIME_DIR,
    endpoint_path,
    fallback_runtime_dir,
    socket_path,
)
from shmmap.segment.directory import DEFAULT_SHM_DIR
from shmmap.segment.names import check_instance

__all__ = ["FILE_NAMES", "DaemonConfig", "load_config", "option_of", "parse_bytes", "trace_settings"]

_SIZE: Final = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?)(i?)b?\s*", re.IGNORECASE)
LARGEST_BYTES: Final = 1 << 62
_ENVIRONMENT: Final = "SHMMAP_"
_TRUTHS: Final = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
_RANGES: Final[dict[str, tuple[Callable[[Any], bool], str]]] = {
    "session_quota": (
        lambda value: 0 < value <= 1 or 1 << 20 <= value <= LARGEST_BYTES,
        "a part of the budget, up to 1, or at least 1M",
    ),
    "workers": (lambda value: 0 <= value <= 64, "0 to 64; 0: one less than there are processors"),
    "load_timeout_s": (lambda value: 0 < value <= 86400, "seconds, more than 0 and at most a day"),
    "budget_bytes": (lambda value: 0 <= value <= LARGEST_BYTES, ""),
    "cache_bytes": (lambda value: 0 <= value <= LARGEST_BYTES, ""),
    "live_budget_bytes": (lambda value: value == 0 or 1 << 22 <= value <= LARGEST_BYTES, "at least 4M"),
    "catalogue_budget_bytes": (lambda value: 1 << 16 <= value <= LARGEST_BYTES, "at least 64K"),
    "poll_s": (lambda value: value == 0 or 1 <= value <= 86400, "seconds, 1 to 86400; 0: never"),
    "accept_version": (lambda value: 0 <= value < 1 << 63, "the number that `shmmap versions URL` shows"),
    "log_level": (lambda value: value in ("debug", "info", "warning"), "debug, info or warning"),
    "unit": (lambda value: value in ("", *UNITS), f"one of {', '.join(UNITS)}"),
    "vertical_unit": (lambda value: value in ("", *UNITS), f"one of {', '.join(UNITS)}"),
    "eviction": (lambda value: value in ("time", "distance", "lru"), "time, distance or lru"),
    "ride_out_s": (lambda value: 0 <= value <= 3600, "seconds, 0 to 3600"),
    "prefetch_share": (
        lambda value: 0 <= value <= 1,
        "a part of the budget, 0 to 1; 0: nothing is fetched ahead",
    ),
}
"""Which values a setting may have, and the hint for who gives another."""
COMMAND_LINE: Final = "command line"
_NOT_SETTINGS: Final = "SHMMAP_TEST_"
FILE_NAMES: Final = {
    "budget_bytes": "budget", "cache_bytes": "cache_size", "live_budget_bytes": "live_budget",
    "catalogue_budget_bytes": "catalogue_budget",
}  # fmt: skip
"""What files, variables and options call a setting, where that is not the attribute's name."""


@dataclass(frozen=True, slots=True)
class DaemonConfig:
    """Every setting of the daemon.

    Attributes
    ----------
    map_path
        Directory of a divided map, one PCD file, or the URL or directory of a published map.
    metadata
        Metadata YAML, where it lies neither beside nor in the map; empty: look there.
    instance
        Name of this daemon among several on one machine.
    runtime_dir, endpoint
        Directory of socket and lock, or the socket itself; empty: the user's or the system's.
    shm_dir
        Where segments live.
    group
        Group that may connect and read; empty: only the daemon's own user.
    admin_group
        Group whose members may reload, evict, pin and shut down, besides root and the daemon's own
        user; they must be able to connect, too.
    budget_bytes
        Most shared memory the daemon uses; 0: a quarter of what is available, at most 4 GiB.
    session_quota
        What one client may keep for itself alone: a part of the budget (up to 1), or bytes (above 1).
    workers
        Most loader processes at a time; 0: one less than there are processors, from 1 to 4, so that
        one is left for who is being served while cells load.  While all of them compute layers there is one
        more, for points alone.
    load_timeout_s
        How long loading one cell may take.
    unit, vertical_unit
        Of a cloud's coordinates, in the plane and in height: ``auto``, ``m``, ``ft`` or ``us-ft``; empty:
        metres, and a cloud that says otherwise is refused.
    strict
        Accept only what Autoware's own loader accepts.
    watch
        Read the map again when its files change (inotify: not on NFS).
    cache_dir
        Where the prepared catalogue and computed layers are kept; empty: the service's or the user's
        cache directory.
    cache_bytes
        Most disk space of computed and prepared layers; 0: none are kept.
    poll_s
        How often it is asked whether a published map has another version; 0: only when a reload is asked for.
    catalogue_budget_bytes
        What the list of cells of a large published map may take of memory; beyond, what was needed least
        recently is fetched again when it is needed.
    trust
        Root of trust, ``ROOT.json``: only versions of a published map that are signed under it are taken;
        empty: any version that the origin names.
    accept_version
        A version of a published map that is taken although a later one was taken before; 0: none.
    insecure_http
        Take a published map from plain ``http://`` beyond this machine.
    instance_credentials
        Ask the cloud's metadata address for credentials if none are given.
    eviction
        ``time``: what will be needed last goes first; ``distance`` or ``lru``.
    ride_out_s
        For so long the map's files may be out of reach without a moving client's noticing: it decides how far
        ahead cells are fetched.
    prefetch_share
        Part of the budget that may be taken by what was fetched ahead and not asked for yet; 0: nothing is.
    live
        The live maps that are kept.
    live_budget_bytes
        Most shared memory of live maps; 0: an eighth of what is available, at most 1 GiB.
    live_shm_dir
        Where their chunks are: a tmpfs without huge pages; empty: /dev/shm where ``shm_dir`` has huge pages,
        else ``shm_dir``.
    live_group
        Group whose members may map, besides root and the daemon's own user.
    log_level
        The least that is logged: ``debug``, ``info`` or ``warning``.
    """

    map_path: str = ""
    metadata: str = ""
    instance: str = DEFAULT_INSTANCE
    runtime_dir: str = ""
    endpoint: str = ""
    shm_dir: str = DEFAULT_SHM_DIR
    group: str = ""
    admin_group: str = ""
    budget_bytes: int = 0
    session_quota: float = 0.9
    workers: int = 0
    load_timeout_s: float = 60.0
    unit: str = ""
    vertical_unit: str = ""
    strict: bool = False
    watch: bool = False
    cache_dir: str = ""
    cache_bytes: int = 8 << 30
    poll_s: float = 60.0
    catalogue_budget_bytes: int = 256 << 20
    trust: str = ""
    accept_version: int = 0
    insecure_http: bool = False
    instance_credentials: bool = False
    eviction: str = "time"
    ride_out_s: float = 10.0
    prefetch_share: float = 0.5
    live: tuple[LiveSettings, ...] = ()
    live_budget_bytes: int = 0
    live_shm_dir: str = ""
    live_group: str = ""
    log_level: str = "info"

    def socket(self) -> str:
        """Path of the request socket."""
        if self.endpoint:
            return endpoint_path(self.endpoint, longer=_events_longer(self.endpoint))
        given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]  # systemd lists all there are
        directory = self.runtime_dir or given or _default_runtime_dir()
        return endpoint_path(socket_path(directory, self.instance), longer=EVENTS_LONGER)

    def loaders(self) -> int:
        """Most loader processes at a time."""
        return self.workers or min(4, max(1, len(os.sched_getaffinity(0)) - 1))


def _events_longer(endpoint: str) -> int:
    """How much longer the path of the socket of events is."""
    return EVENTS_LONGER + (0 if endpoint.endswith(".sock") else len(".sock"))


def _default_runtime_dir() -> str:
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    if own.startswith("/"):
        return f"{own}/shmmap"
    return SYSTEM_RUNTIME_DIR if os.geteuid() == 0 else fallback_runtime_dir()


def parse_bytes(text: str) -> int:
    """Read a size such as ``512M``, ``2GiB`` or ``1000000`` (powers of 1024), at most 2^62 bytes.

    Raises
    ------
    ConfigError
        It is no size, or a larger one.
    """
    match = _SIZE.fullmatch(text)
    nbytes = float(match[1]) * 1024.0 ** " kmgt".index(match[2].lower() or " ") if match else math.inf
    if not nbytes <= LARGEST_BYTES:
        raise ConfigError(f"{text!r} is no size", hint="write for example 512M or 2G")
    return int(nbytes)


def option_of(name: str) -> str:
    """Return what the command line calls a setting."""
    if name == "map_path":
        return "MAP"
    return "--" + FILE_NAMES.get(name, name).removesuffix("_s").replace("_", "-")


def _convert(name: str, value: Any, origin: str) -> Any:
    """Check one setting's type and range."""
    kind = type(getattr(DaemonConfig(), name))
    called = option_of(name) if origin == COMMAND_LINE else FILE_NAMES.get(name, name)
    is_possible, hint = _RANGES.get(name, (lambda _value: True, ""))
    try:
        if name in FILE_NAMES:  # those are sizes
            value = parse_bytes(value) if isinstance(value, str) else value
        if name == "session_quota" and isinstance(value, str) and not value.replace(".", "").isdigit():
            value = float(parse_bytes(value))
        if name == "instance" and isinstance(value, str):
            check_instance(value)
        if kind is bool and isinstance(value, str):
            value = _TRUTHS[value.lower()]
        elif kind in (int, float) and isinstance(value, str):
            value = kind(value)
        elif kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise ValueError
    except ConfigError as error:
        raise ConfigError(
            f"{origin}: {called}: {error.message}", key=name, origin=origin, hint=error.hint
        ) from None
    except (KeyError, ValueError, OverflowError):
        raise ConfigError(
            f"{origin}: {called} must be {KINDS[kind]}, not {value!r}", key=name, origin=origin, hint=hint
        ) from None
    if not is_possible(value):
        raise ConfigError(f"{origin}: {called} cannot be {value!r}", key=name, origin=origin, hint=hint)
    return value


def _unknown(name: str, origin: str) -> ConfigError:
    names = [FILE_NAMES.get(field.name, field.name) for field in fields(DaemonConfig)]
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"settings are: {', '.join(names)}"
    return ConfigError(f"{origin}: unknown setting {name!r}", key=name, origin=origin, hint=hint)


def load_config(
    flags: Mapping[str, Any], *, file: str = "", environ: Mapping[str, str] = os.environ
) -> DaemonConfig:
    """Put the settings together; later origins override earlier ones.

    Parameters
    ----------
    flags
        Settings given on the command line, by attribute name or by their name in the file; None means
        not given.
    file
        TOML file, empty for none.
    environ
        Variables named ``SHMMAP_`` and the setting in capitals count.  As for clients, ``SHMMAP_ENDPOINT``
        does not count beside a flag that names another instance or directory.

    Raises
    ------
    ConfigError
        An unknown key (with a suggestion), a wrong type or an impossible value, and where it is set.
    """
    found = trace_settings(flags, file=file, environ=environ)
    return DaemonConfig(**{name: setting.value for name, setting in found.items()})


def trace_settings(
    flags: Mapping[str, Any], *, file: str = "", environ: Mapping[str, str] = os.environ
) -> dict[str, Setting]:
    """Return every setting with its origin; parameters and errors are those of `load_config`."""
    given: list[tuple[str, Any, str]] = []  # later ones override earlier ones
    if file:
        given += [(name, value, origin) for name, (value, origin) in read_settings_file(file).items()]
    elsewhere = any(flags.get(name) is not None for name in ("instance", "runtime_dir"))
    given += [
        (name.removeprefix(_ENVIRONMENT).lower(), value, name)
        for name, value in environ.items()
        if name.startswith(_ENVIRONMENT)
        and not name.startswith(_NOT_SETTINGS)
        and not (name == "SHMMAP_ENDPOINT" and elsewhere)
    ]
    given += [(name, value, COMMAND_LINE) for name, value in flags.items() if value is not None]
    settings = {field.name: Setting(field.default, "default") for field in fields(DaemonConfig)}
    attributes = {called: name for name, called in FILE_NAMES.items()}
    live: dict[str, list[tuple[Any, str]]] = {"tables": [], "flags": []}
    for word, value, origin in given:
        if word == "live":
            live[
                "tables" if isinstance(value, Mapping) or origin.startswith(file or "\0") else "flags"
            ].append((value, origin))
            continue
        name = attributes.get(word, word)
        if name not in settings or (word in FILE_NAMES and origin != COMMAND_LINE):
            raise _unknown(word, origin)
        settings[name] = Setting(_convert(name, value, origin), origin)
    settings["live"] = _live(live["tables"], live["flags"])
    endpoint = settings["endpoint"]
    if endpoint.value and settings["instance"].origin == "default":
        # clients that know the socket alone look for the segments of the instance it is named after
        settings["instance"] = Setting(_instance_of(endpoint.value), endpoint.origin)
    return settings


def _live(tables: list[tuple[Any, str]], flags: list[tuple[Any, str]]) -> Setting:
    """Put the settings of live maps together: of those that variables or the command line name, too."""
    origins = [origin for _, origin in (*tables, *flags)]
    names = [
        name.strip()
        for value, _ in flags
        for name in (value.split(",") if isinstance(value, str) else value)
        if name.strip()
    ]
    table, table_origin = tables[-1] if tables else ({}, "")
    return Setting(live_settings(names, table, table_origin), " and ".join(origins) or "default")


def _instance_of(endpoint: str) -> str:
    """Return the instance that a socket's name stands for; the default one where it cannot be a name."""
    try:
        return check_instance(os.path.basename(endpoint_path(endpoint)).removesuffix(".sock"))
    except (BadRequest, ConfigError):
        return DEFAULT_INSTANCE
