# SPDX-License-Identifier: Apache-2.0
"""The shared-memory directory as the daemon uses it: make, publish, retire, list and remove segments.

Nothing here maps a segment or keeps it open: the kernel's report of a segment's users (`shmmap.segment.pins`)
counts every open file, including the daemon's own.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator

from shmmap.errors import CannotStart
from shmmap.failpoints import step
from shmmap.segment.header import PublishBlock, pack_publish_block
from shmmap.segment.names import DEFAULT_SHM_DIR


def measured_bytes(fd: int) -> int:
    """Return the bytes of memory that a file really occupies (``st_blocks`` counts 512-byte units)."""
    return os.fstat(fd).st_blocks * 512


class ShmDirectory:
    """A directory on a tmpfs, by default that of POSIX shared memory.

    Raises
    ------
    CannotStart
        If it is missing, not writable, or its file system has no unnamed temporary files
        (``O_TMPFILE``; every tmpfs has them).
    """

    def __init__(self, path: str = DEFAULT_SHM_DIR) -> None:
        self.path = os.path.abspath(path)
        try:
            self._fd = os.open(self.path, os.O_DIRECTORY | os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise CannotStart(
                f"shared-memory directory {self.path}: {error.strerror}", hint="name a directory on a tmpfs"
            ) from error
        try:
            os.close(self.create())
        except OSError as error:
            os.close(self._fd)
            hint = "free some, or enlarge it" if is_full(error) else "name a writable directory on a tmpfs"
            raise CannotStart(
                f"shared-memory directory {self.path}: cannot create a file there: {error.strerror}",
                hint=hint,
            ) from error

    def close(self) -> None:
        """Close the directory; its files stay."""
        os.close(self._fd)

    def create(self) -> int:
        """Open an unnamed file; it vanishes with its last descriptor unless published."""
        return os.open(self.path, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o400)

    def publish(
        self, fd: int, name: str, *, block: PublishBlock, header_bytes: int, mode: int, gid: int
    ) -> int:
        """Stamp, chmod and name a finished segment; return the bytes it occupies.

        The name appears last, so any process that can open the segment sees it complete.
        """
        step("daemon.stamp")
        os.pwrite(fd, pack_publish_block(block), header_bytes - 64)
        if gid >= 0:
            os.fchown(fd, -1, gid)
        os.fchmod(fd, mode)
        nbytes = measured_bytes(fd)
        os.ftruncate(fd, nbytes)  # whole pages: a handle states the bytes that can be mapped
        step("daemon.link")
        self.link(fd, name)
        step("daemon.linked")
        return nbytes

    def link(self, fd: int, name: str) -> None:
        """Give an unnamed file a name; raise FileExistsError if the name exists."""
        # src_dir_fd makes CPython call linkat(2); link(2) would try to link the symlink in /proc
        os.link(
            f"/proc/self/fd/{fd}",
            name.lstrip("/"),
            src_dir_fd=self._fd,
            dst_dir_fd=self._fd,
            follow_symlinks=True,
        )

    def open(self, name: str) -> int:
        """Open a segment for reading; close it soon, since an open file counts as a user."""
        # a pipe of that name would block the opener
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        return os.open(name.lstrip("/"), flags, dir_fd=self._fd)

    def open_path(self, name: str) -> int:
        """Open a segment by ``O_PATH``: once unlinked, its memory is freed when this is closed."""
        return os.open(name.lstrip("/"), os.O_PATH | os.O_CLOEXEC | os.O_NOFOLLOW, dir_fd=self._fd)

    @contextlib.contextmanager
    def opened(self, name: str) -> Iterator[int]:
        """`open` a segment for a moment."""
        fd = self.open(name)
        try:
            yield fd
        finally:
            os.close(fd)

    def rename(self, old: str, new: str) -> bool:
        """Rename a segment; False if it is gone."""
        step("daemon.rename")
        try:
            os.rename(old.lstrip("/"), new.lstrip("/"), src_dir_fd=self._fd, dst_dir_fd=self._fd)
        except FileNotFoundError:
            return False
        step("daemon.renamed")
        return True

    def unlink(self, name: str) -> bool:
        """Remove a name; False if it is gone already."""
        step("daemon.unlink")
        try:
            os.unlink(name.lstrip("/"), dir_fd=self._fd)
        except FileNotFoundError:
            return False
        step("daemon.unlinked")
        return True

    def size_of(self, name: str) -> int:
        """Return the length of a segment in bytes; -1 if it is gone or not a regular file."""
        try:
            status = os.stat(name.lstrip("/"), dir_fd=self._fd, follow_symlinks=False)
        except OSError:
            return -1
        return status.st_size if stat.S_ISREG(status.st_mode) else -1

    def names(self, prefix: str) -> list[str]:
        """Return the names that start with ``prefix`` (slash included), sorted."""
        bare = prefix.lstrip("/")
        with os.scandir(self.path) as entries:
            return sorted("/" + entry.name for entry in entries if entry.name.startswith(bare))

    def used_bytes(self, prefix: str) -> int:
        """Return the memory of files whose names start with ``prefix``, bytes."""
        total = 0
        for name in self.names(prefix):
            with contextlib.suppress(FileNotFoundError):
                total += os.stat(name.lstrip("/"), dir_fd=self._fd, follow_symlinks=False).st_blocks * 512
        return total

    def free_bytes(self) -> int:
        """Return the bytes available to this user in the file system; very large if it has no limit."""
        state = os.statvfs(self._fd)
        return state.f_bavail * state.f_frsize if state.f_blocks else 1 << 62

    def size_bytes(self) -> int:
        """Return the size of the file system in bytes; very large if it has no limit."""
        state = os.statvfs(self._fd)
        return state.f_blocks * state.f_frsize if state.f_blocks else 1 << 62


def is_full(error: OSError) -> bool:
    """Return whether ``error`` means that the file system is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.ENOMEM)
