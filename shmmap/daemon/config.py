# SPDX-License-Identifier: Apache-2.0
"""Settings of the daemon: defaults, overridden by one TOML file, ``SHMMAP_*`` variables, and flags."""

from __future__ import annotations

import os
import re
import stat
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from shmmap.config_table import (
    LARGEST_BYTES,
    Allowed,
    at_least,
    near_hint,
    one_of,
    parse_bytes,
    rows_of,
    setting,
    within,
)
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
from shmmap.segment.names import DEFAULT_SHM_DIR, check_instance

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

if TYPE_CHECKING:
    from shmmap.live_settings import LiveSettings

SYSTEM_CONFIG_FILE: Final = "/etc/shmmap/shmmap.toml"
MAX_BYTES: Final = 1 << 20
_KEY: Final = re.compile(r"""\s*(?:"([^"]+)"|'([^']+)'|([A-Za-z0-9_-]+))\s*[.=]|\s*\[+\s*([A-Za-z0-9_-]+)""")
_ENVIRONMENT: Final = "SHMMAP_"
COMMAND_LINE: Final = "command line"
_NOT_SETTINGS: Final = "SHMMAP_TEST_"
SECTIONS: Final = {
    "map_path": "the map",
    "poll_s": "a published map",
    "budget_bytes": "memory",
    "workers": "loading and logging",
    "instance": "how clients find the daemon",
    "live_budget_bytes": "live maps",
}
"""Headings in the help and in the example file, by the first setting of each section."""
DROPPED: Final = {"eviction": "what clients will need last is always evicted first"}
"""Removed settings, and what applies instead."""
RENAMED: Final = {"ride_out_s": "outage_tolerance_s"}
"""Former names of settings, with their present names."""


class Setting(NamedTuple):
    """A setting's value and its origin: ``FILE:LINE``, a variable, the flags, or the default."""

    value: Any
    origin: str


def _quota(text: str) -> float:
    """Parse a fraction of the budget, or a size."""
    return float(text) if text.replace(".", "").isdigit() else float(parse_bytes(text))


def _specs(text: str) -> tuple[str, ...]:
    """Split a variable's list of layer specs at the commas outside of brackets."""
    found, depth = [""], 0
    for letter in text:
        depth += (letter == "(") - (letter == ")")
        if letter == "," and not depth:
            found.append("")
        else:
            found[-1] += letter
    return tuple(spec.strip() for spec in found if spec.strip())


@dataclass(frozen=True, slots=True)
class DaemonConfig:
    """All settings of the daemon; an empty text or 0 has the meaning given by `Row.unset`."""

    map_path: str = setting(
        "",
        "the map: a directory in Autoware's divided format (PCD files and pointcloud_map_metadata.yaml), one "
        "cloud of any format that is read, or the URL or directory of a published map, such as s3://maps/town",
        metavar="MAP",
    )
    metadata: str = setting("", "the map's YAML", metavar="FILE", unset="beside or inside the map")
    unit: str = setting(
        "",
        "unit of a cloud's coordinates, converted to metres; auto takes what the file says",
        allowed=one_of(*UNITS),
        unset="metres, and a file that states another unit is refused",
    )
    vertical_unit: str = setting(
        "",
        "unit of a cloud's heights, where it differs from that of its coordinates",
        allowed=one_of(*UNITS),
        unset="that of its coordinates, or what the file says",
    )
    drop_noise: bool = setting(
        False,
        "leave out points of a cloud that its LAS file classifies as noise (classes 7 and 18); those flagged "
        "withheld are always left out",
    )
    strict: bool = setting(False, "accept only what Autoware's own loader accepts")
    watch: bool = setting(
        False,
        "read the map again when its files change on this machine; NFS and the like do not report changes "
        "made elsewhere: there, use `shmmap reload`",
    )

    poll_s: float = setting(
        60.0,
        "how often, in seconds, to look for another version (`shmmap versions`)",
        metavar="SECONDS",
        allowed=within(1, 86400, "seconds"),
        unset="only on `shmmap reload`",
    )
    catalogue_budget_bytes: int = setting(
        256 << 20,
        "most memory for the list of cells, a million of them in 256M; beyond, what was needed least "
        "recently is fetched again when it is needed",
        metavar="BYTES",
        allowed=at_least("64K"),
        size="catalogue_budget",
    )
    trust: str = setting(
        "",
        "root of trust: take only versions that are signed under it, and none older than one taken before",
        metavar="ROOT.json",
        unset="the version that the map's origin names is taken unverified",
    )
    link_rate: float = setting(
        0.0,
        "most of the link that the map's cells may take, Mbit/s in all",
        metavar="MBIT_S",
        allowed=within(0.01, 1e6, "Mbit/s"),
        unset="what the link carries",
    )
    metered: bool = setting(
        False, "fetch only cells that clients ask for: nothing ahead, and no list of cells that nothing needs"
    )
    accept_version: int = setting(
        0,
        "number of a version that is taken although a later one was taken before",
        metavar="N",
        allowed=Allowed(lambda value: 0 <= value < 1 << 63, "the number that `shmmap versions URL` shows"),
        unset="none",
    )
    insecure_http: bool = setting(
        False, "accept plain http:// from other machines, although it can be read and changed in transit"
    )
    instance_credentials: bool = setting(
        False, "ask the cloud's metadata address for credentials if none are given"
    )

    budget_bytes: int = setting(
        0,
        "most shared memory for cells, bytes or a size such as 512M or 2G (powers of 1024); one that does "
        "not fit is refused",
        metavar="BYTES",
        allowed=at_least("0"),
        size="budget",
        unset="a quarter of the memory available at start, at most 4 GiB",
    )
    session_quota: float = setting(
        0.9,
        "what one client may keep for itself alone: a part of the budget, up to 1, or a size such as 1G",
        metavar="PART",
        allowed=Allowed(
            lambda value: 0 < value <= 1 or 1 << 20 <= value <= LARGEST_BYTES,
            "a part of the budget, up to 1, or at least 1M",
        ),
        parse=_quota,
    )
    outage_tolerance_s: float = setting(
        10.0,
        "prefetch far enough to bridge an outage of the map's storage of this many seconds, unnoticed by "
        "moving clients; cells of a published map go to the disk where memory has no room",
        metavar="SECONDS",
        allowed=within(0, 3600, "seconds"),
    )
    prefetch_share: float = setting(
        0.5,
        "part of the budget that cells fetched ahead may take until a client asks for them",
        metavar="PART",
        allowed=within(0, 1, "as a part of the budget"),
        unset="nothing is fetched ahead",
    )
    shm_dir: str = setting(
        DEFAULT_SHM_DIR,
        "directory of the segments, on a tmpfs; clients learn it from the daemon",
        metavar="DIR",
    )

    workers: int = setting(
        0,
        "most loader processes at a time; one more loads points while all of them compute layers",
        metavar="N",
        allowed=within(0, 64),
        unset="one less than there are processors, from 1 to 4",
    )
    load_timeout_s: float = setting(
        60.0,
        "most time for loading one cell, in seconds; then its loader is killed, and the cell reported failed",
        metavar="SECONDS",
        allowed=Allowed(lambda value: 0 < value <= 86400, "seconds, more than 0 and at most a day"),
    )
    cache_dir: str = setting(
        "",
        "where the map's index, divided clouds and computed layers are kept between starts",
        metavar="DIR",
        unset="the service's or the user's cache directory",
    )
    cache_bytes: int = setting(
        8 << 30,
        "most disk space for computed and prepared layers, and fetched objects of a published map",
        metavar="SIZE",
        allowed=at_least("0"),
        size="cache_size",
        unset="none are kept",
    )
    prepare: tuple[str, ...] = setting(
        (),
        "layers to compute for every cell of a map of files, such as ndt(leaf=2.0), and to keep in the disk "
        "cache; one loader of the lowest priority does it while nothing else is loaded",
        metavar="LAYER",
        parse=_specs,
        unset="a layer is computed when a client asks for it",
    )
    log_level: str = setting(
        "info",
        "the least that is logged: debug (each eviction, each client that left), info or warning",
        metavar="LEVEL",
        allowed=one_of("debug", "info", "warning"),
    )

    instance: str = setting(
        DEFAULT_INSTANCE,
        "name of this daemon among several on one machine; shmmapd@NAME sets it",
        metavar="NAME",
        parse=check_instance,
    )
    endpoint: str = setting(
        "",
        "request socket, a path or an ipc:// URL",
        metavar="PATH",
        unset="INSTANCE.sock in the runtime directory",
    )
    runtime_dir: str = setting(
        "",
        "directory of the request socket and its lock",
        metavar="DIR",
        unset="/run/shmmap; for a user's daemon $XDG_RUNTIME_DIR/shmmap, else /tmp/shmmap-UID",
    )
    group: str = setting(
        "",
        "group whose members may connect and read the map",
        metavar="GROUP",
        unset="only the daemon's own user may",
    )
    admin_group: str = setting(
        "",
        "group whose members may also reload, evict, pin and stop; they must be able to connect, too",
        metavar="GROUP",
        unset="only root and the daemon's own user may",
    )

    live_budget_bytes: int = setting(
        0,
        "most memory of all live maps together, beside the budget of cells",
        metavar="BYTES",
        allowed=at_least("4M"),
        size="live_budget",
        unset="an eighth of the room shared with cells, all of it where no map is served; at most 1 GiB",
    )
    live_shm_dir: str = setting(
        "",
        "directory of live maps' chunks, a tmpfs without huge pages",
        metavar="DIR",
        unset="that of the segments; /dev/shm where that has huge pages",
    )
    live_group: str = setting(
        "",
        "group whose members may change live maps; they must be able to connect, too",
        metavar="GROUP",
        unset="only root and the daemon's own user may",
    )
    live: tuple[LiveSettings, ...] = ()

    def socket(self) -> str:
        """Path of the request socket."""
        if self.endpoint:
            return endpoint_path(self.endpoint, longer=_events_longer(self.endpoint))
        given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]  # systemd lists all runtime directories
        directory = self.runtime_dir or given or _default_runtime_dir()
        return endpoint_path(socket_path(directory, self.instance), longer=EVENTS_LONGER)

    def loaders(self) -> int:
        """Maximum number of loader processes."""
        return self.workers or min(4, max(1, len(os.sched_getaffinity(0)) - 1))


ROWS: Final = rows_of(DaemonConfig)
"""Metadata of the settings, by attribute; `DaemonConfig.live` has tables of its own."""


def _events_longer(endpoint: str) -> int:
    """Return by how many bytes the event socket's path is longer."""
    return EVENTS_LONGER + (0 if endpoint.endswith(".sock") else len(".sock"))


def _default_runtime_dir() -> str:
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    if own.startswith("/"):
        return f"{own}/shmmap"
    return SYSTEM_RUNTIME_DIR if os.geteuid() == 0 else fallback_runtime_dir()


def option_of(name: str) -> str:
    """Return the command-line option of a setting, given its attribute."""
    if name == "map_path":
        return "MAP"
    called = ROWS[name].called if name in ROWS else name
    return "--" + called.removesuffix("_s").replace("_", "-")


def load_config(
    flags: Mapping[str, Any], *, file: str = "", environ: Mapping[str, str] = os.environ
) -> DaemonConfig:
    """Combine the settings; later sources override earlier ones.

    Parameters
    ----------
    flags
        Settings given on the command line, by attribute or by name in the file; None means not given.
    file
        TOML file; empty for none.
    environ
        Source of variables named ``SHMMAP_`` and the setting in capitals.  As for clients,
        ``SHMMAP_ENDPOINT`` is ignored beside a flag that names another instance or directory.

    Raises
    ------
    ConfigError
        A key is unknown (with a suggestion), or a value has the wrong type or range; the message names
        its origin.
    """
    found = trace_settings(flags, file=file, environ=environ)
    prepare = found["prepare"]
    if prepare.value and not found["cache_bytes"].value:
        raise ConfigError(
            f"{prepare.origin}: prepare keeps layers in the disk cache, and cache_size is 0",
            key="prepare",
            origin=prepare.origin,
            hint="name a cache_size such as 8G, or prepare nothing",
        )
    return DaemonConfig(**{name: one.value for name, one in found.items()})


def trace_settings(
    flags: Mapping[str, Any], *, file: str = "", environ: Mapping[str, str] = os.environ
) -> dict[str, Setting]:
    """Return every setting with its origin; parameters and errors are those of `load_config`."""
    in_file = read_settings_file(file) if file else {}
    live_tables, live_flags = in_file.pop("live", Setting({}, "")), list[Setting]()
    elsewhere = any(flags.get(name) is not None for name in ("instance", "runtime_dir"))
    given = [(name, *one) for name, one in in_file.items()]  # later ones override earlier ones
    given += [
        (name.removeprefix(_ENVIRONMENT).lower(), value, name)
        for name, value in environ.items()
        if name.startswith(_ENVIRONMENT)
        and not name.startswith(_NOT_SETTINGS)
        and not (name == "SHMMAP_ENDPOINT" and elsewhere)
    ]
    given += [(name, value, COMMAND_LINE) for name, value in flags.items() if value is not None]
    settings = {field.name: Setting(field.default, "default") for field in fields(DaemonConfig)}
    attributes = {row.called: name for name, row in ROWS.items()}
    for word, value, origin in given:
        if word == "live":
            live_flags.append(Setting(value, origin))
            continue
        name = attributes.get(word, word if origin == COMMAND_LINE else "")
        if name not in ROWS:
            raise _no_setting(word, origin)
        called = option_of(name) if origin == COMMAND_LINE else word
        value = ROWS[name].checked(value, f"{origin}: {called}", key=name, origin=origin)
        settings[name] = Setting(value, origin)
    settings["live"] = _live(live_tables, live_flags)
    if settings["prepare"].value:
        settings["prepare"] = _prepare(*settings["prepare"])
    endpoint = settings["endpoint"]
    if endpoint.value and settings["instance"].origin == "default":
        # clients that know only the socket look for the segments of the instance named by it
        settings["instance"] = Setting(_instance_of(endpoint.value), endpoint.origin)
    return settings


def _no_setting(word: str, origin: str) -> ConfigError:
    """Return the error for an unknown or removed setting."""
    if word in DROPPED or word in RENAMED:
        called, new, remove = word, RENAMED.get(word, ""), "delete this line"
        if origin == COMMAND_LINE:
            called, new, remove = option_of(word), option_of(new), "leave it out"
        elif origin.startswith(_ENVIRONMENT):
            new, remove = _ENVIRONMENT + new.upper(), f"unset {origin}"
        why, hint = (f"it is {new} now", f"write {new}") if word in RENAMED else (DROPPED[word], remove)
        return ConfigError(f"{origin}: {called} is gone: {why}", key=word, origin=origin, hint=hint)
    hint = near_hint(word, [*(row.called for row in ROWS.values()), "live"])
    return ConfigError(f"{origin}: unknown setting {word!r}", key=word, origin=origin, hint=hint)


def _prepare(specs: tuple[str, ...], origin: str) -> Setting:
    """Return the canonical forms of the layers to prepare."""
    from shmmap.layers.spec import canonical_layers

    called = option_of("prepare") if origin == COMMAND_LINE else "prepare"
    try:
        return Setting(canonical_layers(specs), origin)
    except BadRequest as error:
        raise ConfigError(
            f"{origin}: {called}: {error.message}", key="prepare", origin=origin, hint=error.hint
        ) from None


def _live(tables: Setting, flags: Sequence[Setting]) -> Setting:
    """Combine the settings of live maps, including those named by variables or the command line."""
    from shmmap.live_settings import live_settings

    origins = [one.origin for one in (tables, *flags) if one.origin]
    names = [
        name.strip()
        for value, _ in flags
        for name in (value.split(",") if isinstance(value, str) else value)
        if name.strip()
    ]
    return Setting(live_settings(names, *tables), " and ".join(origins) or "default")


def _instance_of(endpoint: str) -> str:
    """Return the instance named by a socket's file name; the default one if that is not a valid name."""
    try:
        return check_instance(os.path.basename(endpoint_path(endpoint)).removesuffix(".sock"))
    except (BadRequest, ConfigError):
        return DEFAULT_INSTANCE


def installed_config_file(environ: Mapping[str, str] = os.environ) -> str:
    """Return the settings file of the installed units: the user's own, else the system's; or empty."""
    own = environ.get("XDG_CONFIG_HOME", "") or os.path.join(environ.get("HOME", "/"), ".config")
    places = [f"{own}/shmmap/shmmap.toml", SYSTEM_CONFIG_FILE]
    return next((place for place in places if os.path.exists(place)), "")


def read_settings_file(path: str) -> dict[str, Setting]:
    """Read the settings of a file.

    Raises
    ------
    ConfigError
        The file cannot be read, or is not valid TOML.
    """
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_BYTES:
            why = "not a regular file" if not stat.S_ISREG(status.st_mode) else "too large for settings"
            raise ConfigError(f"{path}: {why}", origin=path, hint="`shmmap config init FILE` writes one")
        text = Path(path).read_text(encoding="utf-8")
        settings: dict[str, Any] = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{path}: it is nested too deeply", origin=path) from None
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}", origin=path, hint="`shmmap config init FILE` writes one"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}", origin=path) from error
    lines = _lines(text)
    return {
        name: Setting(value, f"{path}:{lines[name]}" if name in lines else path)
        for name, value in settings.items()
    }


def _lines(text: str) -> dict[str, int]:
    """Return the first line of each key at the top level.

    A line in a multi-line string may look like a key, but the text before it is then not valid TOML.
    """
    found: dict[str, int] = {}
    lines = text.splitlines(keepends=True)
    for number, line in enumerate(lines, start=1):
        match = _KEY.match(line)
        name = next(filter(None, match.groups()), "") if match else ""
        if name and name not in found and _is_toml("".join(lines[: number - 1])):
            found[name] = number
    return found


def _is_toml(text: str) -> bool:
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return False
    return True


_HEAD: Final = """\
# SPDX-License-Identifier: Apache-2.0
# Settings of shmmapd.  Every setting is here; those that are commented out show their default.
# SHMMAP_* variables (SHMMAP_BUDGET=2G) override this file, options of `shmmap serve` override both.
# `shmmap config check FILE` looks for mistakes, `shmmap config show --origin FILE` says what counts.
"""
_LIVE_HEAD: Final = """
# Each live map has a table of its own, which stands behind all other settings:
#[live.lidar]
"""


def example_file(given: Mapping[str, Any]) -> str:
    """Return a configuration file that explains every setting.

    Parameters
    ----------
    given
        Values to set, by attribute; all other settings are commented out, with their defaults.
    """
    import textwrap

    from shmmap.live_settings import LIVE_ROWS

    def comment(words: str, indent: str) -> str:
        return textwrap.fill(words, 110, initial_indent=indent, subsequent_indent=indent)

    text = _HEAD
    for name, row in ROWS.items():
        if name in SECTIONS:
            text += f"\n# --- {SECTIONS[name]} ---\n"
        words, line = row.example(given.get(name))
        text += f"\n{comment(words, '# ')}\n{'' if name in given else '#'}{line}\n"
    text += _LIVE_HEAD
    for row in LIVE_ROWS.values():
        words, line = row.example()
        text += f"{comment(words, '#  ')}\n#  {line}\n"
    return text
