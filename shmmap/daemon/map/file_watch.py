# SPDX-License-Identifier: Apache-2.0
"""Watches the map's files with inotify(7), so that the map is reloaded automatically when they change.

The meaning of a path may change without any event in its directory: a link in the path, for example
``maps/current``, is redirected, or a parent directory is renamed.  Such changes are detected, too.

A map is written file by file, so a change takes effect once the files have been left alone for a moment, and
at the latest some seconds after it began.  The kernel reports only changes made on this machine: on network
file systems such as NFS, a reload has to be requested.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable
from typing import Final

from shmmap.daemon.host.inotify import (
    ALSO,
    CHANGED,
    CREATED,
    DIRECTORY,
    ENDED,
    NAMES_CHANGED,
    OVERFLOW,
    SELF_GONE,
    SELF_MOVED,
    Inotify,
)
from shmmap.errors import CannotStart
from shmmap.logfmt import log
from shmmap.mounts import REMOTE, mount_of

SETTLE_S: Final = 0.5
MAX_DELAY_S: Final = 5.0
MAX_LINKS: Final = 40
"""Number of links that the kernel follows."""
LOOK_S: Final = 1.0
"""Interval of checking whether a vanished directory exists again."""


def directories_of(map_path: str, metadata: str, id_prefix: str) -> set[str]:
    """Return the directories whose files make up a map; all cell ids start with ``id_prefix``."""
    found = {map_path if os.path.isdir(map_path) else os.path.dirname(map_path)}
    if metadata:
        found.add(os.path.dirname(os.path.abspath(metadata)))
    prefix = os.path.dirname(id_prefix)
    if os.path.isdir(prefix):
        found.add(prefix)
    return {directory or "." for directory in found}


def steps_to(path: str) -> dict[str, set[str]]:
    """Return the real directories along an absolute path, each with its links that the path follows."""
    steps: dict[str, set[str]] = {}
    names, here, links = path.split("/")[::-1], "/", 0
    while names:
        name = names.pop()
        if name in ("", "."):
            continue
        if name == "..":
            here = os.path.dirname(here)
            continue
        followed = steps.setdefault(here, set())
        next_step = os.path.join(here, name)
        try:
            target = os.readlink(next_step)
        except OSError:  # not a link
            here = next_step
            continue
        followed.add(name)
        links += 1
        if links > MAX_LINKS:
            break
        names += target.split("/")[::-1]
        here = "/" if target.startswith("/") else here
    return steps


class FileWatch:
    """Watches directories for changes of their files.

    Parameters
    ----------
    directories
        Directories to watch; one that vanishes is watched again when it reappears, which counts as a change.

    Attributes
    ----------
    fd : int
        Readable after a change: call `drain` then.

    Raises
    ------
    CannotStart
        The kernel's limit of watches for this user is reached.
    """

    def __init__(self, directories: Iterable[str]) -> None:
        try:
            self._inotify = Inotify()
        except OSError as error:
            raise _refusal(error) from error
        self.fd = self._inotify.fd
        self._since_s: float | None = None
        self._last_s = self._look_s = 0.0
        self._paths: dict[int, str] = {}
        self._steps: dict[int, set[str]] = {}
        self._missing: set[str] = set()
        for directory in sorted(directories):
            refused = self._add(directory)
            if refused is not None and refused.errno not in (errno.ENOENT, errno.ENOTDIR):
                self.close()
                raise _refusal(refused)
            if (mount := mount_of(directory)).kind in REMOTE:
                log.warning(
                    "changes made on other machines are not noticed",
                    directory=directory,
                    file_system=mount.kind,
                    hint="shmmap reload",
                )

    def follow(self, directories: Iterable[str]) -> None:
        """Watch further directories as soon as they exist; repeated calls have no effect."""
        for directory in directories:
            self._add(directory)

    def _add(self, directory: str) -> OSError | None:
        """Watch a directory; return the error if that fails."""
        for place, links in steps_to(os.path.abspath(directory)).items():
            mask = ALSO | SELF_GONE | (NAMES_CHANGED if links else 0)
            with contextlib.suppress(OSError):  # a directory that this user may not read
                self._steps.setdefault(self._inotify.add(place, mask), set()).update(links)
        try:
            self._paths[self._inotify.add(directory, CHANGED | ALSO)] = directory
        except OSError as error:
            self._missing.add(directory)
            return error
        self._missing.discard(directory)
        return None

    def drain(self, now_s: float) -> None:
        """Read the kernel's events, a bounded number at a time."""
        for event in self._inotify.read():
            lost = event.mask & OVERFLOW
            if lost or event.mask & SELF_GONE or event.name in self._steps.get(event.watch, ()):
                self._path_changed(now_s)
            if event.mask & ENDED:
                self._steps.pop(event.watch, None)
            if event.watch not in self._paths:
                continue
            if event.mask & SELF_MOVED:  # watch the path, not the directory that was moved
                self._inotify.remove(event.watch)
            if event.mask & (SELF_MOVED | ENDED):
                self._missing.add(self._paths.pop(event.watch))
            # a file that was only created is still empty: its writer will close or rename it
            if not event.mask & ENDED and (event.mask & DIRECTORY or not event.mask & CREATED):
                self._note(now_s)

    def _path_changed(self, now_s: float) -> None:
        """Watch the paths again as soon as they exist: they may lead to other directories now."""
        for watch in {**self._paths, **self._steps}:
            self._inotify.remove(watch)
        self._missing.update(self._paths.values())
        self._paths.clear()
        self._steps.clear()
        self._look_s = 0.0
        self._note(now_s)

    def _note(self, now_s: float) -> None:
        if self._since_s is None:
            self._since_s = now_s
        self._last_s = now_s

    def take_change(self, now_s: float) -> bool:
        """Return whether to read the map again now, and forget the changes if so."""
        if self._missing and now_s >= self._look_s:
            self._look_s = now_s + LOOK_S
            before = len(self._missing)
            self.follow(sorted(self._missing))
            if len(self._missing) < before and self._since_s is None:
                self._note(now_s)
        since_s = self._since_s
        if since_s is None or (now_s - self._last_s < SETTLE_S and now_s - since_s < MAX_DELAY_S):
            return False
        self._since_s = None
        return True

    def close(self) -> None:
        """Stop watching."""
        self._inotify.close()


def _refusal(error: OSError) -> CannotStart:
    limits = "raise fs.inotify.max_user_watches and max_user_instances, or leave out --watch"
    return CannotStart(f"cannot watch the map: {error.strerror}", hint=limits)
