# SPDX-License-Identifier: Apache-2.0
"""The file system that a service is installed into: this machine's, or an image's below some directory.

Paths are those that the installed system will have.  Symbolic links are followed as it will follow them: an
absolute one starts at the image's root, and none leads out of it.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from shmmap.errors import BadRequest, CannotWrite

__all__ = ["FileSystem"]

_MAX_LINKS: Final = 40  # as Linux, in one path


class FileSystem:
    """The file system below a directory.

    Parameters
    ----------
    root
        The directory, ``/`` for this machine.

    Raises
    ------
    BadRequest
        It is no directory.
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
        """Whether it is this machine's, and not an image's."""
        return self.root == "/"

    def inside(self, path: str) -> str:
        """Return a path as the installed system will have it: one that lies below the root less the root."""
        found = os.path.abspath(path)
        for root in {self.root, os.path.abspath(self.root)} - {"/"}:
            for name in (found, os.path.realpath(found)):
                if name == root or name.startswith(root + "/"):
                    return name[len(root) :] or "/"
        return found

    def resolve(self, path: str) -> str:
        """Follow every symbolic link of a path inside, the last one, too; what is not there stays as it is.

        Raises
        ------
        CannotWrite
            Links lead in a circle.
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
        """Return where something inside lies for this process; links in its directory are followed.

        Its last name is not: a link there is the thing itself.
        """
        directory, name = os.path.split(path)
        return Path(os.path.normpath(f"{self.root}/{self.resolve(directory)}/{name}"))

    def status(self, path: str) -> os.stat_result | None:
        """Return what something inside is, links followed; None where it is not there."""
        try:
            return os.lstat(self.root + self.resolve(path))
        except (OSError, CannotWrite):
            return None

    def is_executable(self, path: str) -> bool:
        """Whether it is a file inside that can be run."""
        status = self.status(path)
        return status is not None and stat.S_ISREG(status.st_mode) and bool(status.st_mode & 0o111)
