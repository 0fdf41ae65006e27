# SPDX-License-Identifier: Apache-2.0
"""Store compiled kernels on disk, and check which may be used; does not import numba.

The directory is ``NUMBA_CACHE_DIR`` if that is set, else ``$CACHE_DIRECTORY/kernels`` (a service), else
``$XDG_CACHE_HOME/shmmap/kernels`` or ``~/.cache/shmmap/kernels``.

The files are optional: a kernel whose file is missing, damaged, of another version or untrusted is compiled
again, and without a writable directory each process compiles its kernels.  A kernel is code that this process
runs, so directory and file must belong to this user or root, and no other account may write there.

A file: 8 bytes of magic, the SHA-256 of what the kernel was made from, the SHA-256 of the kernel, the kernel.
A file is complete and flushed before it gets its name.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import secrets
import stat
import sys
import time
from pathlib import Path
from typing import Final

from shmmap.logfmt import log
from shmmap.private_directory import PRIVATE, NotPrivate, opened_private, refuse_planted_above, why_not_own
from shmmap.version import __version__

_MAGIC: Final = b"SHMMAPK\x01"
_MAX_BYTES: Final = 64 << 20  # the largest kernel has a few hundred kB
_ABANDONED_S: Final = 3600.0

_said: set[str] = set()
_unkept: list[str] = []


def kernel_directory() -> Path | None:
    """Return the directory of compiled kernels, created if missing; None, logged once, if unusable."""
    try:
        path = _place()
        refuse_planted_above(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with _opened(path, make=PRIVATE):
            return path
    except (OSError, RuntimeError) as error:  # RuntimeError: no home directory
        _not_kept(error)
        return None


def compiled_mark() -> Path | None:
    """Return the file that marks all kernels of layers as compiled, for this version, Python and numba.

    None if kernels cannot be stored, or numba is not installed.
    """
    directory, numba = kernel_directory(), importlib.util.find_spec("numba")
    if directory is None or not os.access(directory, os.W_OK) or numba is None or not numba.origin:
        return None
    try:
        which = os.stat(numba.origin).st_mtime_ns
    except OSError:
        return None
    return directory / f"layers-{__version__}-{sys.implementation.cache_tag}-{which:x}.compiled"


def are_compiled() -> bool:
    """Return whether the kernels of layers are known to be compiled, for this user."""
    mark = compiled_mark()
    return mark is not None and mark.is_file()


def read_kernel(name: str, source: bytes) -> bytes | None:
    """Return the kernel of this name that was made from ``source``; None if there is no usable one.

    Parameters
    ----------
    name
        Name of the kernel's file.
    source
        All data on which the kernel depends.
    """
    if (directory := kernel_directory()) is None:
        return None
    try:
        data = _read(directory, name)
    except FileNotFoundError:
        return None
    except (OSError, MemoryError) as error:
        discard(name, error)
        return None
    head, rest = data[: len(_MAGIC) + 64], memoryview(data)[len(_MAGIC) + 64 :]
    if head[: len(_MAGIC)] != _MAGIC or head[-32:] != hashlib.sha256(rest).digest():
        discard(name, "damaged")
        return None
    return bytes(rest) if head[len(_MAGIC) : -32] == hashlib.sha256(source).digest() else None


def write_kernel(name: str, source: bytes, data: bytes) -> None:
    """Store a kernel, replacing any of that name; a failure is logged once."""
    if (directory := kernel_directory()) is None:
        return
    unfinished = f"{name}.{secrets.token_hex(4)}.tmp"
    try:
        with _opened(directory) as parent:
            try:
                fd = os.open(
                    unfinished, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600, dir_fd=parent
                )
                with open(fd, "wb") as file:
                    file.write(_MAGIC + hashlib.sha256(source).digest() + hashlib.sha256(data).digest())
                    file.write(data)
                    file.flush()
                    os.fsync(fd)
                os.rename(unfinished, name, src_dir_fd=parent, dst_dir_fd=parent)
            except OSError:
                with contextlib.suppress(OSError):
                    os.unlink(unfinished, dir_fd=parent)
                raise
    except OSError as error:
        _not_kept(error)


def discard(name: str, why: object) -> None:
    """Remove an unusable kernel, and the mark that all are compiled; logged once."""
    if (directory := kernel_directory()) is None:
        return
    _say("compiled kernel discarded", path=directory / name, reason=_words(why))
    for path in (directory / name, compiled_mark()):
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink()


def all_kept() -> bool:
    """Return whether all kernels that this process compiled are stored and flushed to disk.

    Also removes unfinished files of killed processes.
    """
    if _unkept or (directory := kernel_directory()) is None:
        return False
    try:
        with _opened(directory) as parent:
            os.fsync(parent)
            for entry in os.scandir(parent):
                status = entry.stat(follow_symlinks=False)
                if entry.name.endswith(".tmp") and status.st_mtime < time.time() - _ABANDONED_S:
                    os.unlink(entry.name, dir_fd=parent)
    except OSError as error:
        _not_kept(error)
        return False
    return True


def _place() -> Path:
    if named := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(named)
    if service := os.environ.get("CACHE_DIRECTORY", "").split(":")[0]:
        return Path(service) / "kernels"
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base.startswith("/") else Path.home() / ".cache") / "shmmap" / "kernels"


def _opened(directory: Path, *, make: int = 0) -> contextlib.AbstractContextManager[int]:
    """Open and check a directory, and give its descriptor, relative to which files are opened."""
    return opened_private(directory, make=make, or_root=True, own_link=True)


def _read(directory: Path, name: str) -> bytes:
    with _opened(directory) as parent:
        # does not block on a pipe, and does not follow a link
        fd = os.open(name, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=parent)
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode):
            raise OSError("not a regular file")
        if why := why_not_own(status, os.geteuid(), or_root=True):
            raise NotPrivate(directory / name, why)
        if status.st_size > _MAX_BYTES:
            raise OSError(f"{status.st_size} bytes, which is too large")
        with open(fd, "rb", closefd=False) as file:
            return file.read()
    finally:
        os.close(fd)


def _not_kept(error: Exception) -> None:
    _unkept.append(str(error))
    with contextlib.suppress(RuntimeError):
        _say(
            "compiled kernels are not kept",
            path=_place(),
            reason=_words(error),
            effect="each process compiles them, which takes some seconds",
        )


def _words(why: object) -> str:
    if isinstance(why, NotPrivate):
        return f"it {why.why}: {why.hint}"
    if isinstance(why, OSError) and why.strerror:
        return why.strerror
    return str(why) or type(why).__name__


def _say(event: str, **details: object) -> None:
    """Log an event once per process, and not again in its children."""
    if event not in _said:
        _said.add(event)
        log.warning(event, **details)
