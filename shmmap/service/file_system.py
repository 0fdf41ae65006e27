# SPDX-License-Identifier: Apache-2.0
"""The file system into which a service is installed: this machine's, or that of an image in a directory.

Paths are those of the installed system, and symbolic links are followed as there: an absolute link starts at
the image's root, and no link leads out of it.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from shmmap.errors import BadRequest, CannotWrite

_MAX_LINKS: Final = 40  # links in one path, as in Linux


class FileSystem:
    """The file system below a directory.

    Parameters
    ----------
    root
        The directory, ``/`` for this machine.

    Raises
    ------
    BadRequest
        ``root`` is not a directory.
    """

    def __init__(self, root: str = "/") -> None:
        if not root or not os.path.isdir(root):
            raise BadRequest(
                f"--root: {root or 'an empty name'!r} is no directory",
                hint="name the directory in which the image's file system begins",
            )
        self.root = os.path.realpath(root)

    @property
    def is_this_machine(self) -> bool:
        """Whether this is the file system of this machine, and not of an image."""
        return self.root == "/"

    def inside(self, path: str) -> str:
        """Return a path as in the installed system: a path below the root loses the root."""
        found = os.path.abspath(path)
        for root in {self.root, os.path.abspath(self.root)} - {"/"}:
            for name in (found, os.path.realpath(found)):
                if name == root or name.startswith(root + "/"):
                    return name[len(root) :] or "/"
        return found

    def resolve(self, path: str) -> str:
        """Resolve all symbolic links of a path inside, including the last; missing parts stay unchanged.

        Raises
        ------
        CannotWrite
            The links form a loop.
        """
        links = 0
        done = "/"
        todo = [name for name in path.split("/") if name]
        while todo:
            name = todo.pop(0)
            if name in (".", ".."):
                done = os.path.dirname(done) if name == ".." else done
                continue
            step = os.path.join(done, name)
            try:
                target = os.readlink(self.root + step)
            except OSError:
                done = step
                continue
            links += 1
            if links > _MAX_LINKS:
                raise CannotWrite(f"{path}: too many symbolic links, or they lead in a circle")
            if target.startswith("/"):
                done = "/"
            todo = [part for part in target.split("/") if part] + todo
        return done

    def outside(self, path: str) -> Path:
        """Return the path for this process of a path inside, with links in its directory resolved.

        The path's last name is not resolved: if it is a link, the result is the link itself.
        """
        directory, name = os.path.split(path)
        return Path(os.path.normpath(f"{self.root}/{self.resolve(directory)}/{name}"))

    def status(self, path: str) -> os.stat_result | None:
        """Return the status of a path inside, with links followed; None if it does not exist."""
        try:
            return os.lstat(self.root + self.resolve(path))
        except (OSError, CannotWrite):
            return None

    def is_executable(self, path: str) -> bool:
        """Return whether a path inside is an executable file."""
        status = self.status(path)
        return status is not None and stat.S_ISREG(status.st_mode) and bool(status.st_mode & 0o111)
