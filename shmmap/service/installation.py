# SPDX-License-Identifier: Apache-2.0
"""What installing the service writes: planned first, so that it can be shown, then done.

Units are replaced (an operator's changes belong in drop-ins), a configuration that exists is kept.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from shmmap.errors import CannotWrite, MapMissing
from shmmap.service.huge_pages import DROP_IN, MOUNT
from shmmap.service.program import (
    bridge_command,
    check_readable,
    daemon_command,
    hidden_directories,
    is_hidden,
    quoted,
)
from shmmap.service.shipped_files import shipped_names, shipped_text

__all__ = ["PlannedFile", "configuration", "plan_system", "plan_user", "unit_text", "write"]

SHIPPED_PROGRAM = "/usr/bin/shmmapd"
SHIPPED_BRIDGE = "/usr/bin/shmmap-ros-bridge"
_GENERATED = "# Written by `shmmap unit install`, which replaces it.\n"


@dataclass(frozen=True, slots=True)
class PlannedFile:
    """One file of an installation.

    Attributes
    ----------
    path, text
        Where it goes and what is in it.
    keep
        An existing one stays as it is.
    """

    path: Path
    text: str
    keep: bool = False

    @property
    def action(self) -> Literal["new", "changed", "same", "kept"]:
        """What writing it means for the file that is there."""
        try:
            old = self.path.read_text(encoding="utf-8")
        except (FileNotFoundError, NotADirectoryError):
            return "new"
        if self.keep:
            return "kept"
        return "same" if old == self.text else "changed"


def unit_text(name: str, root: str = "/") -> str:
    """Return a shipped unit with the program of this installation in it, as ``root`` will see it."""
    text = shipped_text(name).replace(SHIPPED_PROGRAM, daemon_command(root))
    return text.replace(SHIPPED_BRIDGE, bridge_command(root))


def configuration(map_path: str = "", *, group: bool = True) -> str:
    """Return the example configuration, with this map and with or without the service's group."""
    text = shipped_text("shmmap.toml")
    if map_path:
        # what JSON quotes is quoted the same way in TOML
        text = re.sub(r"^map_path = .*$", lambda _: f"map_path = {json.dumps(map_path)}", text, flags=re.M)
    return text if group else re.sub(r"^group = .*$", '#group = ""', text, flags=re.M)


def _map_path(given: str) -> str:
    path = os.path.abspath(given) if given else ""
    if path and not os.path.exists(path):
        raise MapMissing(f"there is no map at {path}")
    return path


def _drop_in(path: Path, directories: Sequence[str], why: str) -> list[PlannedFile]:
    """A drop-in that shows directories to the daemon.

    One that is needed no more is emptied of settings, for nothing is deleted here.
    """
    if not directories and not path.exists():
        return []
    lines = "".join(f"BindReadOnlyPaths={quoted(place)}\n" for place in directories)
    return [PlannedFile(path, f"{_GENERATED}# {why}\n[Service]\n{lines}")]


def plan_system(map_path: str = "", root: str = "/", *, huge_pages: bool = False) -> list[PlannedFile]:
    """Return what a service for the whole machine needs.

    Parameters
    ----------
    map_path
        The map of the plain service; empty: what the example says.
    root
        Where the machine's file system begins: another directory than ``/`` for a package or an image.
    huge_pages
        Keep the segments on a tmpfs of their own, with huge pages; kept where an earlier installation did.

    Raises
    ------
    MapMissing
        There is nothing at ``map_path``.
    ConfigError
        The service's account could not read this program.
    """
    map_path = _map_path(map_path)
    check_readable()
    etc = Path(root) / "etc"
    units = etc / "systemd" / "system"
    planned = [
        PlannedFile(units / Path(name).name, unit_text(name, root))
        for name in shipped_names()
        if name.startswith("system/") and not name.endswith(".mount")
    ]
    why = "This Python lies where ProtectHome= or PrivateTmp= would hide it."
    for service in ("shmmapd.service", "shmmapd@.service", "shmmap-ros-bridge.service"):
        planned += _drop_in(units / f"{service}.d" / "10-program.conf", hidden_directories(root=root), why)
    if map_path:
        shown = [map_path] if is_hidden(map_path) else []
        why = "The map lies where ProtectHome= or PrivateTmp= would hide it."
        planned += _drop_in(units / "shmmapd.service.d" / "20-map.conf", shown, why)
    mount = units / Path(MOUNT).name
    if huge_pages or mount.exists():
        planned.append(PlannedFile(mount, shipped_text(MOUNT)))
        for service in ("shmmapd.service", "shmmapd@.service"):
            path = units / f"{service}.d" / "30-huge-pages.conf"
            planned.append(PlannedFile(path, _GENERATED + shipped_text(DROP_IN)))
    for name in ("sysusers.d/shmmap.conf", "tmpfiles.d/shmmap.conf"):
        planned.append(PlannedFile(etc / name, shipped_text(name)))
    return [*planned, PlannedFile(etc / "shmmap" / "shmmap.toml", configuration(map_path), keep=True)]


def plan_user(map_path: str = "", config_home: str = "") -> list[PlannedFile]:
    """Return what a user's own service needs; parameters and errors as for `plan_system`."""
    map_path = _map_path(map_path)
    home = Path(config_home or os.environ.get("XDG_CONFIG_HOME", "") or Path.home() / ".config")
    return [
        *(
            PlannedFile(home / "systemd" / name, unit_text(name))
            for name in shipped_names()
            if name.startswith("user/")
        ),
        PlannedFile(home / "shmmap" / "shmmap.toml", configuration(map_path, group=False), keep=True),
    ]


def write(planned: Sequence[PlannedFile]) -> None:
    """Write the files that are new or changed, each in one step.

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
            interim.write_text(one.text, encoding="utf-8")
            interim.chmod(0o644)
            interim.replace(one.path)
        except OSError as error:
            denied = isinstance(error, PermissionError)
            raise CannotWrite(
                f"cannot write {one.path}: {error.strerror}",
                hint="run it with sudo, or with --user" if denied else "",
            ) from error
