# SPDX-License-Identifier: Apache-2.0
"""The directory where mappers put files with the marks of their scans; the content is not trusted.

The directory belongs to the daemon; members of the mappers' group may create files in it and remove their own
(mode 1770).  A file is named after the session that created it, and removed when that session has ended.
The directory is ``shmmap-live.<instance>.marks``: ``shmmap.<instance>.`` begins the name of a segment.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
from typing import Final

from shmmap.errors import BadRequest
from shmmap.private_directory import PRIVATE, open_private

MAX_MARKS_BYTES: Final = 32 << 20
"""Maximum length of one scan's marks; 120 000 points make 0.2 MB."""

_NAME: Final = re.compile(r"([0-9a-f]{1,16})\.[0-9]{1,20}")


class MarksDirectory:
    """Files of marks.

    Parameters
    ----------
    path
        Path on a tmpfs.  The directory is created, and files of a previous run are removed.
    gid
        Group whose members may map; -1: only the owner may.

    Raises
    ------
    OSError
        The directory cannot be created, or belongs to another user.
    """

    def __init__(self, path: str, gid: int = -1) -> None:
        self.path = path
        self._fd = open_private(path, make=PRIVATE, refused=0)  # its mode may be another group's
        try:
            if gid >= 0:
                os.fchown(self._fd, -1, gid)
            os.fchmod(self._fd, 0o1770 if gid >= 0 else 0o700)
            self._remove_all()
        except BaseException:
            os.close(self._fd)
            raise

    def take(self, name: str, nbytes: int, session: int, uid: int) -> bytes:
        """Return the content of a file of marks, and remove the file to free its memory for chunks.

        Parameters
        ----------
        name, nbytes
            As in the mapper's request.
        session, uid
            Session and user that must own the file.

        Raises
        ------
        BadRequest
            It is not a valid file of marks of this session; the message contains the reason.
        """
        found = _NAME.fullmatch(name)
        if found is None or found[1] != f"{session:x}":
            raise BadRequest(f"marks: {name!r} is not a name that this session may use")
        if not 0 < nbytes <= MAX_MARKS_BYTES:
            raise BadRequest(f"marks: {nbytes} bytes; {MAX_MARKS_BYTES} are the most")
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
        try:
            fd = os.open(name, flags, dir_fd=self._fd)
        except OSError as error:
            raise BadRequest(f"marks: {name} cannot be opened: {error.strerror}") from error
        try:
            status = os.fstat(fd)
            if not stat.S_ISREG(status.st_mode) or status.st_uid != uid:
                raise BadRequest(f"marks: {name} is no regular file of this user")
            if status.st_size != nbytes:
                raise BadRequest(f"marks: {name} has {status.st_size} bytes, not {nbytes}")
            data = os.pread(fd, nbytes, 0)
        finally:
            os.close(fd)
        self._remove(name)
        if len(data) != nbytes:
            raise BadRequest(f"marks: {name} was cut to {len(data)} bytes")
        return data

    def on_disconnect(self, session: int) -> None:
        """Remove the files of a session that has ended."""
        start = f"{session:x}."
        for name in os.listdir(self._fd):
            if name.startswith(start):
                self._remove(name)

    def close(self) -> None:
        """Remove the directory, and all that is in it."""
        self._remove_all()
        os.close(self._fd)
        with contextlib.suppress(OSError):
            os.rmdir(self.path)

    def _remove_all(self) -> None:
        for name in os.listdir(self._fd):
            self._remove(name)

    def _remove(self, name: str) -> None:
        try:
            os.unlink(name, dir_fd=self._fd)
        except IsADirectoryError:
            with contextlib.suppress(OSError):  # a directory that is not empty stays
                os.rmdir(name, dir_fd=self._fd)
        except FileNotFoundError:
            pass
