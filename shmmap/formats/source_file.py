# SPDX-License-Identifier: Apache-2.0
"""Read a cloud file once from front to back, with its digest; and the causes of all errors.

`MapDataError.cause` of any error that this package raises is a key of `CAUSES`; the keys are stable for
programs, the messages are for people.
"""

from __future__ import annotations

import os
import re
import stat
from types import TracebackType
from typing import Any, Final, NoReturn, TypeVar

import numpy as np
import xxhash
from numpy.typing import NDArray

from shmmap.errors import MapDataError

_Self = TypeVar("_Self", bound="FileReader")

_LFS: Final = b"version https://git-lfs"
_FIRST_READ_BYTES: Final = 4096  # long enough for nearly every header


def open_regular(path: str) -> int:
    """Open a regular file for reading; return its descriptor.

    Raises
    ------
    MapDataError
        ``missing``, ``unreadable``, or ``not_regular``; so a pipe never blocks the caller.
    """
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise refusal("missing", "no such file", path=path) from None
    except OSError as error:
        raise refusal("unreadable", f"cannot be opened: {error.strerror}", path=path) from error
    except ValueError as error:  # the path contains a NUL
        raise refusal("unreadable", f"cannot be opened: {error}", path=path) from error
    mode = os.fstat(fd).st_mode
    if not stat.S_ISREG(mode):
        os.close(fd)
        kind = "a directory, not a file" if stat.S_ISDIR(mode) else "not a regular file"
        raise refusal("not_regular", kind, path=path)
    return fd


class FileReader:
    """A reader that keeps a file open until it is closed, or its ``with`` block ends.

    Raises
    ------
    MapDataError
        As `open_regular`.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self._fd = open_regular(self.path)
        try:
            self._source = SourceFile(self._fd, self.path)
            self._read_header()
        except BaseException:
            self.close()
            raise

    def _read_header(self) -> None:
        """Read and check the header; the file is closed if this raises."""

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def fileno(self) -> int:
        """Return the open file's descriptor."""
        return self._fd

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1


class SourceFile:
    """Sequential reads of an open file by ``pread``, every byte passing through XXH3-128 once.

    Attributes
    ----------
    size
        Bytes of the file when it was opened.
    at
        Offset of the next byte to be read.
    """

    def __init__(self, fd: int, path: str) -> None:
        self._fd = fd
        self.path = path
        self.size = os.fstat(fd).st_size
        self.at = 0
        self._hash = xxhash.xxh3_128()
        self._buffer: NDArray[np.uint8] = np.empty(0, np.uint8)

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return self.size - self.at

    def peek(self, count: int) -> bytes:
        """Return up to ``count`` bytes from the start of the file, without digesting them."""
        try:
            return os.pread(self._fd, count, 0)
        except OSError as error:
            self._unreadable(error, self.at)

    def head(self, end: re.Pattern[bytes], most: int) -> bytes:
        """Return the start of the file as `peek` does: some bytes, or ``most`` where these lack ``end``."""
        head = self.peek(_FIRST_READ_BYTES)
        return head if len(head) >= self.size or end.search(head) else self.peek(most)

    def start(self, head: bytes) -> None:
        """Digest ``head``, the first bytes of the file, and continue after them."""
        self.at = len(head)
        self._hash.reset()
        self._hash.update(head)

    def read(self, count: int) -> NDArray[np.uint8]:
        """Return the next ``count`` bytes in a buffer that the next call reuses.

        Raises
        ------
        MapDataError
            ``truncated`` if the file has become shorter than it was when opened.
        """
        if len(self._buffer) < count:
            self._buffer = np.empty(count, np.uint8)
        part = self._buffer[:count]
        self.read_into(part)
        return part

    def read_into(self, part: NDArray[np.uint8]) -> None:
        """Fill ``part`` with the next bytes; errors as in `read`."""
        self.read_at(part, self.at)
        self._hash.update(part.data)
        self.at += len(part)

    def read_at(self, part: NDArray[np.uint8], offset: int) -> None:
        """Fill ``part`` with the bytes at ``offset``, without digesting them; errors as in `read`."""
        view: memoryview[Any] = part.data
        while view:
            try:
                got = os.preadv(self._fd, [view], offset)
            except OSError as error:
                self._unreadable(error, offset)
            if not got:
                message = "the file became shorter while being read"
                raise refusal("truncated", message, path=self.path, offset=offset)
            view, offset = view[got:], offset + got

    def digest(self) -> bytes:
        """XXH3-128 of everything read so far."""
        return bytes(self._hash.digest())

    def _unreadable(self, error: OSError, offset: int) -> NoReturn:
        message = f"cannot be read: {error.strerror}"
        raise refusal("unreadable", message, path=self.path, offset=offset) from error


CAUSES: Final[dict[str, str]] = {
    "missing": "there is no such file",
    "unreadable": "the operating system refuses to open or read it",
    "not_regular": "a directory, pipe or device, not a file",
    "empty_file": "no bytes at all",
    "zero_filled": "nothing but zero bytes, as after a power loss",
    "lfs_pointer": "a git-lfs pointer: the data was never fetched",
    "not_pcd": "something else than PCD",
    "bad_header": "the header contradicts itself or lacks a line",
    "bad_type": "a type of values that the format does not have",
    "no_xyz": "no usable x, y and z",
    "unknown_encoding": "an encoding that the format does not have",
    "too_many_points": "more points than the format can mean",
    "too_large": "more points than a layer is computed of",
    "changed": "the file changed while it was being read",
    "truncated": "the file ends before its data does",
    "bad_lzf": "the compressed block contradicts its sizes or cannot be decompressed",
    "bad_row": "a row has too few or many values, or one that is not a number of its type",
    "coordinate_range": "a 64-bit integer coordinate that float64 cannot hold exactly",
    "unsupported_format": "a file format that is not read",
    "not_metres": "coordinates in feet or another unit, and nothing that says to convert them",
    "bad_las": "a LAS or LAZ file that contradicts itself or cannot be decompressed",
}


def refusal(
    cause: str, message: str, *, path: str, offset: int | None = None, hint: str = ""
) -> MapDataError:
    """Return the error for ``cause`` (a key of `CAUSES`); the caller raises it."""
    if cause not in CAUSES:
        raise KeyError(cause)
    return MapDataError(message, path=path, offset=offset, cause=cause, hint=hint)


def refuse_no_data(head: bytes, path: str) -> None:
    """Check that a file's first bytes could be data of some format.

    Raises
    ------
    MapDataError
        ``empty_file``, ``zero_filled`` or ``lfs_pointer``.
    """
    if not head:
        raise refusal("empty_file", "the file is empty (0 bytes)", path=path, offset=0)
    if not head.strip(b"\0"):
        raise refusal("zero_filled", "nothing but zero bytes", path=path, offset=0)
    if head.startswith(_LFS):
        message = "a git-lfs pointer instead of the data"
        raise refusal("lfs_pointer", message, path=path, offset=0, hint="run git lfs pull")
