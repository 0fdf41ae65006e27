# SPDX-License-Identifier: Apache-2.0
"""What a limit of the process, or of its control group, forbids: by the limit's name and value.

The kernel's own words ("Resource temporarily unavailable", "File too large") name no limit.
"""

from __future__ import annotations

import errno
import os
import resource
from typing import Final, NamedTuple

__all__ = ["Limit", "file_size_limit", "limit_behind"]

_MEMORY: Final = ("Cannot allocate memory", "failed to map segment", "MemoryError")


class Limit(NamedTuple):
    """A limit that was reached: what it forbids and how large it is, and what to do."""

    message: str
    hint: str


def file_size_limit() -> int | None:
    """Bytes that a file of this process may have (RLIMIT_FSIZE); None where there is no limit."""
    soft, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    return None if soft == resource.RLIM_INFINITY else soft


def limit_behind(error: BaseException) -> Limit | None:
    """Return the limit that an error comes of; None where it comes of none."""
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.EAGAIN or "can't start new thread" in str(error):
        group = _group_limit("pids.max")
        said = f"RLIMIT_NPROC of this user is {_value(resource.RLIMIT_NPROC)}"
        said += f", pids.max of the control group {group:,}" if group is not None else ""
        for name, which in (("RLIMIT_DATA", resource.RLIMIT_DATA), ("RLIMIT_AS", resource.RLIMIT_AS)):
            if (value := _value(which)) != "unlimited":  # of which a thread's stack is part
                said += f", {name} {value}"
        return Limit(
            f"no more processes or threads may be started: {said}",
            "raise them (ulimit -u, -d, -v; LimitNPROC=, LimitDATA=, TasksMax=, docker --pids-limit): the"
            " daemon needs about 30 threads",
        )
    if number == errno.EFBIG:
        return Limit(
            f"a file may not be larger: RLIMIT_FSIZE is {_value(resource.RLIMIT_FSIZE)}",
            "raise it (ulimit -f, LimitFSIZE=) above the size of the largest segment",
        )
    if number == errno.EMFILE:
        return Limit(
            f"no more files may be open: RLIMIT_NOFILE is {_value(resource.RLIMIT_NOFILE)}",
            "raise it (ulimit -n, LimitNOFILE=)",
        )
    limited = {_value(resource.RLIMIT_DATA), _value(resource.RLIMIT_AS)} != {"unlimited"}
    is_memory = isinstance(error, MemoryError) or number == errno.ENOMEM
    is_memory = is_memory or (limited and isinstance(error, SystemError))  # now and then CPython's word
    if is_memory or (isinstance(error, ImportError) and any(text in str(error) for text in _MEMORY)):
        data, space = _value(resource.RLIMIT_DATA), _value(resource.RLIMIT_AS)
        return Limit(
            f"no more memory may be used: RLIMIT_DATA is {data}, RLIMIT_AS {space}",
            "raise it (ulimit -d, ulimit -v, LimitDATA=, LimitAS=): the daemon and a loader need about 1 GiB",
        )
    return None


def _value(which: int) -> str:
    soft, _ = resource.getrlimit(which)
    if soft == resource.RLIM_INFINITY:
        return "unlimited"
    counts = which in (resource.RLIMIT_NPROC, resource.RLIMIT_NOFILE)
    return f"{soft:,}" if counts else f"{soft:,} bytes"


def _group_limit(name: str) -> int | None:
    """The smallest limit of this process's control group and those above; None where there is none."""
    try:
        with open("/proc/self/cgroup", encoding="utf-8", errors="replace") as file:
            groups = [line.rstrip("\n").split(":", 2) for line in file]
    except OSError:
        return None
    limits = []
    for _, controllers, path in groups:
        place = path if not controllers else ""
        while place:
            try:
                with open(f"/sys/fs/cgroup{place}/{name}", encoding="ascii") as file:
                    text = file.read().strip()
                limits += [int(text)] if text.isdecimal() else []
            except (OSError, ValueError):
                pass
            place = os.path.dirname(place) if place != "/" else ""
    return min(limits, default=None)
