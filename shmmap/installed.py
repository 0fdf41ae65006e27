# SPDX-License-Identifier: Apache-2.0
"""Whether the package on the disk is still the one that this process runs.

An upgrade replaces files under running programs.  A module imported afterwards would be missing, or of
another version than those in memory.  So each import of a module of ours is preceded by a look at the
package: once that was replaced, the import is refused with `Replaced`, and nothing of the new version is
ever loaded into a process of the old one.  A process that starts a child passes `mark` on, and a child of
another version ends.
A daemon goes on with the processes that it has, until it needs another one.

The look compares inodes and times of the package's directory and of its ``version.py``, which every installer
writes.  A process that runs for long also remembers those of all modules (`remember_modules`): a checkout may
change under it, or an upgrade stop half-way.
"""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Final

from shmmap.errors import Replaced

RESTART: Final = "shmmap was replaced: restart the daemon"

OURS: Final = ("shmmap", "shmmap_clients")
"""Packages of ours, which are installed and replaced together."""

_DIRECTORY: Final = os.path.dirname(os.path.abspath(__file__))
_VERSION_FILE: Final = os.path.join(_DIRECTORY, "version.py")


def _look() -> str:
    """Return what identifies the package on the disk; empty if it is not there."""
    try:
        directory, version = os.stat(_DIRECTORY), os.stat(_VERSION_FILE)
    except OSError:
        return ""
    return f"{directory.st_ino:x}-{version.st_ino:x}-{version.st_mtime_ns:x}-{version.st_size:x}"


mark: Final = _look()
"""What identifies the package that this process runs; empty if it is not in files."""

_noticed: list[bool] = []
_modules: dict[str, tuple[int, int]] = {}
"""Inode and time of each module's file, by path; empty unless they were remembered."""


def _found_modules(directory: str = _DIRECTORY) -> dict[str, tuple[int, int]]:
    found: dict[str, tuple[int, int]] = {}
    with os.scandir(directory) as entries:
        for entry in entries:
            name = entry.name
            if name.endswith(".py"):
                status = entry.stat()
                found[entry.path] = status.st_ino, status.st_mtime_ns
            elif "." not in name and not name.startswith("__") and entry.is_dir():
                found.update(_found_modules(entry.path))
    return found


def remember_modules() -> None:
    """Remember all modules of the package as they are now; takes a millisecond."""
    if mark and not _modules:
        with contextlib.suppress(OSError):
            _modules.update(_found_modules())


def _has_changed(module: str) -> bool:
    """Return whether the file of a module is another one than when the modules were remembered."""
    place = os.path.join(_DIRECTORY, *module.split(".")[1:])
    for path in (f"{place}.py", os.path.join(place, "__init__.py")):
        try:
            status = os.stat(path)
        except OSError:
            continue
        return _modules.get(path) != (status.st_ino, status.st_mtime_ns)
    return any(path.startswith(f"{place}{end}") for path in _modules for end in (".py", os.sep))


def is_replaced() -> bool:
    """Return whether the package was replaced or removed since this process imported it."""
    replaced = bool(mark) and _look() != mark
    if not replaced and _modules:
        try:
            replaced = _found_modules() != _modules
        except OSError:
            replaced = True
    if replaced:
        _noticed[:] = [True]
    return replaced


def is_installed() -> bool:
    """Return whether there is a package on the disk, of whichever version."""
    return bool(_look())


def was_noticed() -> bool:
    """Return whether something found out that the package was replaced; does not look at the disk."""
    return bool(_noticed)


def refuse_if_replaced(what: str) -> None:
    """Refuse to load something of a package that was replaced or removed.

    Raises
    ------
    Replaced
        The package on the disk is not the one that this process runs.
    """
    if is_replaced():
        raise _refusal(what)


def _refusal(what: str) -> Replaced:
    _noticed[:] = [True]
    return Replaced(
        "shmmap was replaced while this program runs: start it again", hint=f"{what} was not loaded before"
    )


class _OfThisVersion:
    """Finder that finds nothing, and refuses modules of a package that was replaced."""

    @classmethod
    def find_spec(cls, name: str, path: object = None, target: object = None) -> None:
        """Return None: other finders find the module."""
        del path, target
        top, _, inner = name.partition(".")
        if top not in OURS or not mark:
            return
        # cheaper than `is_replaced`: each import comes here
        if _look() != mark or (inner and top == OURS[0] and _modules and _has_changed(name)):
            raise _refusal(name)


sys.meta_path.insert(0, _OfThisVersion)
