# SPDX-License-Identifier: Apache-2.0
"""How a unit starts the daemon: from this installation, or from that of an image.

The units hide home directories and /tmp from the daemon.  An installation there (a virtual environment in a
home, a Python of pyenv or uv) is made visible again, read-only and without other files.  Files that only
their owner may read stay inaccessible to the service: such an installation is refused, with the commands to
install the program where every account can read it.
"""

from __future__ import annotations

import os
import re
import stat
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from shmmap.errors import ConfigError
from shmmap.service.file_system import FileSystem

INSTALL_FOR_SERVICE: Final = "python3 -m venv /opt/shmmap && /opt/shmmap/bin/pip install ."
"""Commands for root, in a checkout, to install the program where a machine's units can start it."""
INSTALL_IN_IMAGE: Final = (
    "cp -r . IMAGE/usr/src/shmmap && chroot IMAGE sh -c"
    " 'python3 -m venv /opt/shmmap && /opt/shmmap/bin/pip install /usr/src/shmmap'"
)
"""The same in an image that has Python."""

_HIDDEN: Final = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108  ProtectHome=, PrivateTmp=
_IN_IMAGES: Final = ("/opt/shmmap/bin", "/usr/local/bin", "/usr/bin")


@dataclass(frozen=True)
class Program:
    """An installation of shmmap as the service's machine will see it.

    Attributes
    ----------
    daemon, bridge
        Commands that start the daemon, and the bridge to ROS.
    places
        Directories that must be visible to the service.
    read
        Directories and files that the service's account must be able to read.
    """

    daemon: tuple[str, ...]
    bridge: tuple[str, ...]
    places: tuple[str, ...]
    read: tuple[str, ...]
    file_system: FileSystem = field(default_factory=FileSystem)

    @classmethod
    def this_one(cls) -> Program:
        """Return the running installation."""

        def command(name: str, module: str) -> tuple[str, ...]:
            script = os.path.join(sys.prefix, "bin", name)
            return (script,) if os.access(script, os.X_OK) else (sys.executable, "-m", module)

        python = os.path.realpath(sys.executable)
        package = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
        needed = (sys.prefix, sys.base_prefix, os.path.dirname(os.path.dirname(python)))
        return cls(
            command("shmmapd", "shmmap.daemon"),
            command("shmmap-ros-bridge", "shmmap_clients.ros_bridge"),
            tuple(os.path.abspath(place) for place in (*needed, *sys.path) if place and os.path.isdir(place)),
            (*needed, python, package, f"{package}/__init__.py"),
        )

    @classmethod
    def in_image(cls, file_system: FileSystem) -> Program:
        """Return an image's installation: this one, if it lies in the image, else that in /opt/shmmap.

        Raises
        ------
        ConfigError
            The image has no installation, or one that would not start there.
        """
        own = file_system.inside(os.path.join(sys.prefix, "bin"))
        for folder in dict.fromkeys((own, *_IN_IMAGES)):
            script = f"{folder}/shmmapd"
            if file_system.is_executable(script):
                break
        else:
            raise ConfigError(
                f"no shmmap is installed below {file_system.root}, and the units could start none",
                hint=f"as root, in shmmap's checkout: {INSTALL_IN_IMAGE}",
            )
        python = _interpreter(file_system, script)
        bridge = f"{folder}/shmmap-ros-bridge"
        if file_system.is_executable(bridge):
            _interpreter(file_system, bridge)
            start_bridge: tuple[str, ...] = (bridge,)
        else:
            start_bridge = (python, "-m", "shmmap_clients.ros_bridge")
        real = file_system.resolve(python)
        places = (os.path.dirname(folder), os.path.dirname(os.path.dirname(real)))
        return cls((script,), start_bridge, places, (*places, script, real), file_system)

    @property
    def metrics(self) -> tuple[str, ...]:
        """Command that prints metrics, of the installation that has the daemon."""
        *before, last = self.daemon
        return (*before, "shmmap.cli" if before else last.removesuffix("d"), "metrics")

    @property
    def hidden_directories(self) -> list[str]:
        """Directories that the program needs, but that the units would hide."""
        return outermost(place for place in self.places if is_hidden(place))

    def check_readable(self) -> None:
        """Raise an error if the service's account, without special rights, cannot read the program.

        Raises
        ------
        ConfigError
            A path is not readable; the message names it, and how to install the program for the service.
        """
        for path in self.read:
            if (closed := self._closed_to_others(path)) is not None:
                install = INSTALL_FOR_SERVICE if self.file_system.is_this_machine else INSTALL_IN_IMAGE
                raise ConfigError(
                    f"the service could not run this program: only its owner may read {closed}",
                    hint=f"install it for the service, as root in shmmap's checkout: {install}",
                )

    def _closed_to_others(self, path: str) -> str | None:
        """Return the first part of ``path`` that other users may not enter or read; None if there is none.

        Directories above one that the units make visible do not matter: their permissions are bypassed.
        """
        shown = self.hidden_directories
        start = next((place for place in shown if path == place or path.startswith(place + "/")), "/")
        steps = [path]
        while steps[-1] not in (start, "/"):
            steps.append(os.path.dirname(steps[-1]))
        for place in reversed(steps):
            status = self.file_system.status(place)
            if status is None:
                return place
            needed = stat.S_IXOTH if stat.S_ISDIR(status.st_mode) else 0
            needed |= stat.S_IROTH if place == path else 0
            if status.st_mode & needed != needed:
                return place
        return None


def _interpreter(file_system: FileSystem, script: str) -> str:
    """Return the interpreter of a script in an image, which must exist there.

    Raises
    ------
    ConfigError
        The interpreter is missing: the script was created outside the image, or the image has no Python.
    """
    with open(file_system.root + file_system.resolve(script), "rb") as file:
        first = file.readline(4096)
    words = os.fsdecode(first[2:]).split() if first.startswith(b"#!") else []
    if not words:  # a program
        return script
    if not file_system.is_executable(words[0]):
        raise ConfigError(
            f"{script} would not start in the image: it is run by {words[0]}, which is not below"
            f" {file_system.root}",
            hint=f"install it from within, as root in shmmap's checkout: {INSTALL_IN_IMAGE}",
        )
    return words[0]


def quoted(word: str) -> str:
    """Return a word quoted for units (systemd.syntax(7)), so that it is neither expanded nor split."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{escaped}"' if re.search(r"[\s\"']", word) else escaped


def is_hidden(path: str) -> bool:
    """Return whether the units hide ``path`` from the daemon."""
    return any(path == place or path.startswith(place + "/") for place in _HIDDEN)


def outermost(paths: Iterable[str]) -> list[str]:
    """Return the paths that lie in none of the others, sorted."""
    kept: list[str] = []
    for path in sorted(set(paths)):
        if not any(path.startswith(other.rstrip("/") + "/") for other in kept):
            kept.append(path)
    return kept


def command_line(words: Sequence[str]) -> str:
    """Return words as a command line for ``ExecStart=``."""
    return " ".join(quoted(word) for word in words)
