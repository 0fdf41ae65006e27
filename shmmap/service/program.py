# SPDX-License-Identifier: Apache-2.0
"""How a unit starts this installation of the daemon, and whether the service's account can read it.

The units hide home directories and /tmp from the daemon.  An installation that lies there (a virtual
environment in a home, a Python of pyenv or uv) is made visible again, read-only and nothing else with
it.  What only its owner may read stays closed to the service: that is refused, with the commands that install
the program where everybody can read it.
"""

from __future__ import annotations

import os
import re
import stat
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from shmmap.errors import ConfigError

__all__ = [
    "INSTALL_FOR_SERVICE",
    "bridge_command",
    "check_readable",
    "daemon_command",
    "hidden_directories",
    "is_hidden",
    "outermost",
    "quoted",
]

INSTALL_FOR_SERVICE: Final = "python3 -m venv /opt/shmmap && /opt/shmmap/bin/pip install ."
"""As root, in a checkout: the program where the units of a machine can start it."""

_HIDDEN: Final = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108  ProtectHome=, PrivateTmp=


def daemon_command(root: str = "/") -> str:
    """Return what starts the daemon of this installation, for ``ExecStart=``.

    Where the installation lies below ``root``, an image's file system, as the image will see it.
    """
    return _command("shmmapd", "shmmap.daemon", root)


def bridge_command(root: str = "/") -> str:
    """Return what starts the bridge to ROS of this installation, as `daemon_command` does."""
    return _command("shmmap-ros-bridge", "shmmap_clients.ros_bridge", root)


def _command(name: str, module: str, root: str) -> str:
    script = Path(sys.prefix, "bin", name)
    command = [str(script)] if os.access(script, os.X_OK) else [sys.executable, "-m", module]
    return " ".join(quoted(word) for word in (_seen_from(root, command[0]), *command[1:]))


def _seen_from(root: str, path: str) -> str:
    """Return ``path`` as it is called where ``root`` is ``/``; itself where it lies elsewhere."""
    below = os.path.abspath(root).rstrip("/") + "/"
    return "/" + path[len(below) :] if path.startswith(below) else path


def quoted(word: str) -> str:
    """Return a word as units write it (systemd.syntax(7)): nothing in it is expanded or split."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{escaped}"' if re.search(r"[\s\"']", word) else escaped


def is_hidden(path: str) -> bool:
    """Whether the units hide ``path`` from the daemon."""
    return any(path == place or path.startswith(place + "/") for place in _HIDDEN)


def outermost(paths: Iterable[str]) -> list[str]:
    """Return the paths that lie in no other of them, sorted."""
    kept: list[str] = []
    for path in sorted(set(paths)):
        if not any(path.startswith(other.rstrip("/") + "/") for other in kept):
            kept.append(path)
    return kept


def _places(search_path: Sequence[str]) -> list[str]:
    """Directories that this Python needs, and those it is told to look for modules in."""
    interpreter = os.path.dirname(os.path.dirname(os.path.realpath(sys.executable)))
    places = [sys.prefix, sys.base_prefix, interpreter, *search_path]
    return [os.path.abspath(place) for place in places if place and os.path.isdir(place)]


def hidden_directories(search_path: Sequence[str] | None = None, *, root: str = "/") -> list[str]:
    """Return the directories that this Python needs and that the units would hide.

    Parameters
    ----------
    search_path
        Where modules are found; `sys.path` by default.
    root
        An image's file system: what lies below it is where the image will see it.
    """
    return outermost(
        place
        for place in (
            _seen_from(root, one) for one in _places(sys.path if search_path is None else search_path)
        )
        if is_hidden(place)
    )


def check_readable() -> None:
    """Refuse an installation that an account without rights of its own, the service's, cannot read.

    Raises
    ------
    ConfigError
        It names what is closed, and how to install the program for the service.
    """
    package = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    wanted = [*_places(()), os.path.realpath(sys.executable), package, f"{package}/__init__.py"]
    shown = hidden_directories()
    for path in wanted:
        if (closed := _closed_to_others(path, shown)) is not None:
            raise ConfigError(
                f"the service could not run this program: only its owner may read {closed}",
                hint=f"install it for the service, as root in shmmap's checkout: {INSTALL_FOR_SERVICE}",
            )


def _closed_to_others(path: str, shown: Sequence[str]) -> str | None:
    """First directory on the way to ``path``, or itself, that others may not enter or read; else None.

    What lies above a directory that the units show does not matter: it is shown whatever that allows.
    """
    start = next((place for place in shown if path == place or path.startswith(place + "/")), "/")
    steps = [path]
    while steps[-1] not in (start, "/"):
        steps.append(os.path.dirname(steps[-1]))
    for place in reversed(steps):
        status = os.stat(place)
        needed = stat.S_IXOTH if stat.S_ISDIR(status.st_mode) else 0
        needed |= stat.S_IROTH if place == path else 0
        if status.st_mode & needed != needed:
            return place
    return None
