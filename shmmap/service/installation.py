# SPDX-License-Identifier: Apache-2.0
"""Install the service: plan the files first, so that the plan can be shown, then write them.

Units are replaced (an operator's changes belong in drop-ins); an existing configuration is kept.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from shmmap.daemon.config import example_file
from shmmap.errors import BadRequest, CannotWrite, InternalError, MapMissing
from shmmap.origin.remote.store import is_url, read_url
from shmmap.service.file_system import FileSystem
from shmmap.service.huge_pages import DROP_IN, MOUNT
from shmmap.service.program import Program, command_line, is_hidden, quoted

EXAMPLE_MAP = "/var/lib/shmmap/maps"

SHIPPED_PROGRAM = "/usr/bin/shmmapd"

SHIPPED_BRIDGE = "/usr/bin/shmmap-ros-bridge"

SHIPPED_METRICS = "/usr/bin/shmmap metrics"

PUBLISHED_MAP = "drop-ins/published-map.conf"

ROOT_OF_TRUST = "ROOT.json"
"""File name of the copy of a root of trust, in the directory of the configuration."""

CREDENTIALS = ("shmmap.aws", "shmmap.google", "shmmap.azure")
"""Files in /etc/shmmap that systemd passes to the service, whose account need not be able to read them."""

_GENERATED = "# Written by `shmmap unit install`, which replaces it.\n"


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """One file of an installation.

    Attributes
    ----------
    path, text
        Path and content of the file.
    keep
        Whether an existing file stays unchanged.
    """

    path: Path
    text: str
    keep: bool = False

    @property
    def action(self) -> Literal["new", "changed", "same", "kept"]:
        """Effect of the installation on this file: create it, change it, or leave it unchanged."""
        if not os.path.lexists(self.path):
            return "new"
        if self.keep:
            return "kept"
        return "same" if self._is_there() else "changed"

    def _is_there(self) -> bool:
        """Return whether a regular file exists at the path; a link, a pipe or a device does not count."""
        wanted = self.text.encode()
        fd = -1
        try:
            fd = os.open(self.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            return stat.S_ISREG(os.fstat(fd).st_mode) and os.pread(fd, len(wanted) + 1, 0) == wanted
        except OSError:
            return False
        finally:
            if fd >= 0:
                os.close(fd)


def unit_text(name: str, program: Program | None = None) -> str:
    """Return a shipped unit that starts a program, by default this installation."""
    program = program or Program.this_one()
    text = shipped_text(name).replace(SHIPPED_PROGRAM, command_line(program.daemon))
    text = text.replace(SHIPPED_METRICS, command_line(program.metrics))
    return text.replace(SHIPPED_BRIDGE, command_line(program.bridge))


def configuration(map_path: str = "", *, group: bool = True, trust: str = "") -> str:
    """Return the example configuration with this map and root of trust, and with or without a group."""
    given = {"map_path": map_path or EXAMPLE_MAP, "trust": trust, "group": "shmmap" if group else ""}
    return example_file({name: value for name, value in given.items() if value})


def _map_path(given: str, file_system: FileSystem) -> tuple[str, bool]:
    """Return the map's path as the service sees it, and whether it is a URL."""
    if is_url(given):
        url = read_url(given)
        if url.scheme != "file":
            return url.text, True
        given = url.path
    if not given:
        return "", False
    path = file_system.inside(given)
    if file_system.status(path) is None:
        raise MapMissing(
            f"there is no map at {file_system.outside(path)}",
            hint=""
            if file_system.is_this_machine
            else f"the service will see what lies below {file_system.root} alone: put the map there",
        )
    return path, False


def _drop_in(path: Path, directories: Sequence[str], why: str) -> list[PlannedFile]:
    """Plan a drop-in that makes directories visible to the daemon.

    A drop-in that is no longer needed is emptied, since an installation deletes no files.
    """
    if not directories and not path.exists():
        return []
    lines = "".join(f"BindReadOnlyPaths={quoted(place)}\n" for place in directories)
    return [PlannedFile(path, f"{_GENERATED}# {why}\n[Service]\n{lines}")]


def _network(path: Path, file_system: FileSystem, *, is_remote: bool) -> list[PlannedFile]:
    """Plan a drop-in that lets the daemon fetch the map, with the existing credentials."""
    if not is_remote and not path.exists():
        return []
    if not is_remote:
        return [PlannedFile(path, f"{_GENERATED}# The map is on this machine.\n")]
    there = [name for name in CREDENTIALS if file_system.status(f"/etc/shmmap/{name}") is not None]
    lines = "".join(f"LoadCredential={name}:/etc/shmmap/{name}\n" for name in there)
    return [PlannedFile(path, _GENERATED + shipped_text(PUBLISHED_MAP) + lines)]


def _root_of_trust(given: str, path: Path) -> list[PlannedFile]:
    """Plan a copy of a root of trust, since the service may not see the original; it is not secret."""
    if not given:
        return []
    from shmmap.origin.remote.verify_apart import read_trusted_root

    return [PlannedFile(path, read_trusted_root(os.path.abspath(given)).decode())]


def plan_system(
    map_path: str = "", root: str = "/", *, huge_pages: bool = False, trust: str = ""
) -> list[PlannedFile]:
    """Return the files for a service for the whole machine.

    Parameters
    ----------
    map_path
        The map of the plain service, or its URL; empty: that of the example.  For an image: its path in the
        image, or its present path below ``root``.
    root
        Root of the machine's file system; for an image, which must contain the program, another directory
        than ``/``.
    huge_pages
        Keep the segments on a separate tmpfs with huge pages; also done if an earlier installation did.
    trust
        Root of trust of a signed published map: a file of this machine, which is copied.

    Raises
    ------
    MapMissing
        There is nothing at ``map_path``.
    BadRequest
        ``root`` is not a directory, or a URL cannot be served.
    ConfigError
        The image has no program, or the service's account could not read it; or ``trust`` is not a root of
        trust.
    """
    file_system = FileSystem(root)
    map_path, is_remote = _map_path(map_path, file_system)
    program = Program.this_one() if file_system.is_this_machine else Program.in_image(file_system)
    program.check_readable()

    def place(*names: str, keep: bool = False) -> Path:
        path = "/".join(("/etc", *names))
        return file_system.outside(file_system.resolve(path) if keep else path)

    units = ("systemd", "system")
    planned = [
        PlannedFile(place(*units, Path(name).name), unit_text(name, program))
        for name in shipped_names()
        if name.startswith("system/") and not name.endswith(".mount")
    ]
    why = "This Python lies where ProtectHome= or PrivateTmp= would hide it."
    for service in ("shmmapd", "shmmapd@", "shmmap-ros-bridge", "shmmap-metrics"):
        planned += _drop_in(
            place(*units, f"{service}.service.d", "10-program.conf"), program.hidden_directories, why
        )
    if map_path:
        shown = [map_path] if not is_remote and is_hidden(map_path) else []
        why = "The map lies where ProtectHome= or PrivateTmp= would hide it."
        planned += _drop_in(place(*units, "shmmapd.service.d", "20-map.conf"), shown, why)
        network = place(*units, "shmmapd.service.d", "25-published-map.conf")
        planned += _network(network, file_system, is_remote=is_remote)
    mount = place(*units, Path(MOUNT).name)
    if huge_pages or mount.exists():
        planned.append(PlannedFile(mount, shipped_text(MOUNT)))
        for service in ("shmmapd.service", "shmmapd@.service"):
            path = place(*units, f"{service}.d", "30-huge-pages.conf")
            planned.append(PlannedFile(path, _GENERATED + shipped_text(DROP_IN)))
    for name in ("sysusers.d/shmmap.conf", "tmpfiles.d/shmmap.conf"):
        planned.append(PlannedFile(place(name), shipped_text(name)))
    planned += _root_of_trust(trust, place("shmmap", ROOT_OF_TRUST))
    config = place("shmmap", "shmmap.toml", keep=True)
    text = configuration(map_path, trust=f"/etc/shmmap/{ROOT_OF_TRUST}" if trust else "")
    return [*planned, PlannedFile(config, text, keep=True)]


def plan_user(map_path: str = "", config_home: str = "", *, trust: str = "") -> list[PlannedFile]:
    """Return the files for a user's own service; parameters and errors as for `plan_system`."""
    map_path, _ = _map_path(map_path, FileSystem())
    home = Path(config_home or os.environ.get("XDG_CONFIG_HOME", "") or Path.home() / ".config")
    return [
        *(
            PlannedFile(home / "systemd" / name, unit_text(name))
            for name in shipped_names()
            if name.startswith("user/")
        ),
        *_root_of_trust(trust, home / "shmmap" / ROOT_OF_TRUST),
        PlannedFile(
            home / "shmmap" / "shmmap.toml",
            configuration(map_path, group=False, trust=str(home / "shmmap" / ROOT_OF_TRUST) if trust else ""),
            keep=True,
        ),
    ]


def write(planned: Sequence[PlannedFile]) -> None:
    """Write the new and changed files, each atomically.

    Raises
    ------
    CannotWrite
        A file cannot be written.
    """
    for one in planned:
        if one.action not in ("new", "changed"):
            continue
        interim = one.path.with_name(f".{one.path.name}.new")
        try:
            one.path.parent.mkdir(parents=True, exist_ok=True)
            interim.unlink(missing_ok=True)
            with interim.open("x", encoding="utf-8") as file:
                file.write(one.text)
            interim.chmod(0o644)
            interim.replace(one.path)
        except OSError as error:
            with contextlib.suppress(OSError):
                interim.unlink()
            denied = isinstance(error, PermissionError)
            raise CannotWrite(
                f"cannot write {one.path}: {error.strerror}",
                hint="run it with sudo, or with --user" if denied else "",
            ) from error


def shipped_directory() -> Path:
    """Return the directory of the files.

    Raises
    ------
    InternalError
        The package was installed without them.
    """
    package = Path(__file__).parent.parent
    for place in (package / "_systemd", package.parent / "systemd"):
        if (place / "shmmap.toml").is_file():
            return place
    raise InternalError("this installation of shmmap came without its unit files")


def shipped_names() -> list[str]:
    """Return all names, relative to the directory: ``system/shmmapd.service``, ..."""
    root = shipped_directory()
    return sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())


def shipped_text(name: str) -> str:
    """Return the text of one file.

    Raises
    ------
    BadRequest
        There is no file of this name; the hint lists the existing ones.
    """
    if name not in shipped_names():
        raise BadRequest(f"there is no file {name!r}", hint="there are: " + ", ".join(shipped_names()))
    return (shipped_directory() / name).read_text(encoding="utf-8")
