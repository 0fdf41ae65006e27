# SPDX-License-Identifier: Apache-2.0
"""The directories of one state of a map, each opened once, so that no link on the way can mix two maps.

``maps/current`` may lead to another map at any moment, or ``..data`` inside a Kubernetes volume may.  What is
read of a state of the map is read through the descriptors that were opened when it was found; ids stay the
paths as given.  A later state (`MapDirectory.load`) opens them again.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from typing import Final

__all__ = ["KUBERNETES_LINK", "OpenedDirectories"]

KUBERNETES_LINK: Final = "..data"
"""In a Kubernetes volume every visible name is a link through this one, which is switched in one step."""


class OpenedDirectories:
    """Opens directories, and translates paths into and below them.

    Parameters
    ----------
    inherited
        Descriptors by path, of a process that has opened them.
    """

    def __init__(self, inherited: Mapping[str, int] | None = None) -> None:
        self.descriptors: dict[str, int] = dict(inherited or {})

    def __del__(self) -> None:
        for fd in self.descriptors.values():
            with contextlib.suppress(OSError):
                os.close(fd)

    def open(self, path: str) -> None:
        """Open a directory, through one that is open if it lies below that; what is none is passed over."""
        if path in self.descriptors:
            return
        flags = os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC
        try:
            fd = os.open(self.at(path), flags)
        except OSError:  # who looks at it says what is wrong
            return
        if _is_volume(fd):
            volume = fd
            try:
                fd = os.open(KUBERNETES_LINK, flags, dir_fd=volume)
            finally:
                os.close(volume)
        self.descriptors[path] = fd

    def at(self, path: str) -> str:
        """Where to find what a path names: below the innermost directory that is open."""
        above, fd = self.innermost(path)
        return f"/proc/self/fd/{fd}{path[len(above.rstrip('/')) :]}" if fd >= 0 else path

    def innermost(self, path: str) -> tuple[str, int]:
        """Path and descriptor of the innermost directory that is open and has ``path`` in it; -1: none."""
        above = path
        while above not in self.descriptors:
            if above in ("", "/"):
                return "", -1
            above = os.path.dirname(above)
        return above, self.descriptors[above]

    def named(self, text: str) -> str:
        """Name paths in a message as they were given."""
        for path, fd in self.descriptors.items():
            text = text.replace(f"/proc/self/fd/{fd}/", path.rstrip("/") + "/")
        return text


def _is_volume(fd: int) -> bool:
    """Whether all that is visible in a directory are links through `KUBERNETES_LINK`."""
    place = f"/proc/self/fd/{fd}"
    if not (os.path.islink(f"{place}/{KUBERNETES_LINK}") and os.path.isdir(f"{place}/{KUBERNETES_LINK}")):
        return False
    try:
        with os.scandir(place) as entries:
            visible = [entry.path for entry in entries if not entry.name.startswith("..")]
        return all(os.readlink(path).startswith(KUBERNETES_LINK + "/") for path in visible)
    except OSError:
        return False
