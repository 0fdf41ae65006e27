# SPDX-License-Identifier: Apache-2.0
"""Name the limit that a process has reached: descriptors, threads, memory, or file size.

The kernel's messages ("Resource temporarily unavailable", "File too large") do not name the limit.

libzmq aborts the process if it gets no descriptor or thread (``epoll.cpp``, ``thread.cpp``).  So a check
takes the needed number for a moment beforehand.  It takes descriptors as objects that close them when they
are dropped, since a signal handler's exception may arrive after any of them.
"""

from __future__ import annotations

import _thread
import errno
import os
import select
import time
from typing import Final

from shmmap.errors import LimitReached

_GONE_S: Final = 0.0001
_NO_ROOM: Final = ("Cannot allocate memory", "failed to map segment")
"""Messages of the dynamic loader for a library for which there is no memory."""


def file_size_limit() -> int | None:
    """Return the largest size of a file of this process (RLIMIT_FSIZE), bytes; None if there is no limit."""
    import resource  # clients rarely need it

    soft, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    return None if soft == resource.RLIM_INFINITY else soft


def limit_behind(error: BaseException) -> LimitReached | None:
    """Return an error that names the limit which caused ``error``; None if no limit did."""
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EMFILE, errno.ENFILE):
        return no_files_left(OSError(number, ""))
    if number == errno.EAGAIN or "can't start new thread" in str(error):
        return no_threads_left("no more processes or threads may be started: ")
    if number == errno.EFBIG:
        most = file_size_limit()
        return LimitReached(
            f"a file may not be larger: RLIMIT_FSIZE is {'not set' if most is None else f'{most:,} bytes'}",
            hint="raise it above the size of the largest segment: ulimit -f, in a unit LimitFSIZE=",
        )
    is_memory = isinstance(error, MemoryError) or number == errno.ENOMEM
    # without memory, CPython may lose the exception itself
    is_memory = is_memory or (isinstance(error, SystemError) and bool(_memory_limits()))
    if is_memory or (isinstance(error, ImportError) and any(text in str(error) for text in _NO_ROOM)):
        return no_memory_left()
    return None


def raise_limit_behind(error: OSError) -> None:
    """Raise the error that names the limit which caused ``error``; do nothing if no limit did.

    Raises
    ------
    LimitReached
        A limit caused it.
    """
    if (limit := limit_behind(error)) is not None:
        raise limit from error


def check_files(count: int, what: str) -> None:
    """Check that this process can open this many more files.

    Raises
    ------
    LimitReached
        The process cannot open that many; the message names ``what``, which needs them.
    """
    held: list[select.epoll] = []
    try:
        for _ in range(count):
            held.append(select.epoll())  # noqa: PERF401  the message contains their number
    except OSError as error:
        left = len(held)
        held.clear()
        limit = no_files_left(error, f"{what} needs {count} more descriptors, {left} are left: ")
        if limit is None:
            raise
        raise limit from None


def no_files_left(error: Exception, what: str = "") -> LimitReached | None:
    """Return an error that names the limit of open files if ``error`` means that; else None."""
    number = getattr(error, "errno", None)
    if number == errno.ENFILE:
        return LimitReached(
            f"{what}the machine has as many files open as it may (fs.file-max)",
            hint="close some, or raise it: sysctl fs.file-max",
        )
    if number == errno.EMFILE or (number is None and _may_open_none()):
        most = os.sysconf("SC_OPEN_MAX")  # as in `resource`, which would have to be loaded from a file
        return LimitReached(
            f"{what}this process has as many files open as it may, {most} (RLIMIT_NOFILE)",
            hint="close some, or raise the limit: ulimit -n, in a unit LimitNOFILE=",
        )
    return None


def _may_open_none() -> bool:
    try:
        select.epoll()
    except OSError as error:
        return error.errno == errno.EMFILE
    return False


def check_threads(count: int, what: str) -> None:
    """Check that this many more threads can be started.

    Raises
    ------
    LimitReached
        That many threads cannot be started; the message names ``what``, which needs them.
    """
    stay = _thread.allocate_lock()
    started: list[str] = []

    def wait() -> None:
        started.append(f"/proc/self/task/{_thread.get_native_id()}")
        with stay:
            pass

    begun = 0
    with stay:
        try:
            for _ in range(count):
                _thread.start_new_thread(wait, ())
                begun += 1
        except RuntimeError:
            raise no_threads_left(f"{what} needs {count} more threads, {begun} can be started: ") from None
        finally:
            while len(started) < begun:
                time.sleep(0)
    # a thread counts until the kernel has removed it
    while any(map(os.path.exists, started)):
        time.sleep(_GONE_S)


def no_threads_left(what: str = "") -> LimitReached:
    """Return an error that names the limits of threads, and how much of each is used."""
    limits = []
    if (most := os.sysconf("SC_CHILD_MAX")) >= 0:
        limits.append(f"{most} processes and threads of this user (RLIMIT_NPROC)")
    if (group := _group_limit()) is not None:
        limits.append(group)
    limits += _memory_limits()
    named = ", ".join(limits) or "those of the machine (kernel.threads-max)"
    return LimitReached(
        f"{what}the limits of this process are {named}",
        hint="end some, or raise the limit: ulimit -u, in a unit LimitNPROC= or TasksMax=",
    )


def _group_limit() -> str | None:
    """Return the strictest thread limit of this process's control groups and their ancestors."""
    from shmmap.mounts import control_groups, group_values

    limits = [most for groups in control_groups("pids") for most in group_values(groups, "pids.max")]
    return f"{min(limits)} in the control group (pids.max)" if limits else None


def no_memory_left(nbytes: int | None = None) -> LimitReached:
    """Return the error for a process that gets no more private memory, with the limits that apply."""
    limits = ", ".join(_memory_limits()) or "no limit is set"
    what = "more private memory is" if nbytes is None else f"{nbytes} bytes of private memory are"
    return LimitReached(
        f"{what} cannot be allocated ({limits})", hint="raise the limit: ulimit -d and -v, or free memory"
    )


def _memory_limits() -> list[str]:
    import resource

    limits = {
        "data (RLIMIT_DATA)": resource.getrlimit(resource.RLIMIT_DATA)[0],
        "address space (RLIMIT_AS)": resource.getrlimit(resource.RLIMIT_AS)[0],
    }
    return [f"{most >> 20} MiB of {name}" for name, most in limits.items() if most != resource.RLIM_INFINITY]
