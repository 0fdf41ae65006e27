# SPDX-License-Identifier: Apache-2.0
"""What a limit forbids is said by its name and value."""

from __future__ import annotations

import errno
import resource
import subprocess
import sys

import pytest

from shmmap.segment.process_limits import limit_behind


@pytest.mark.parametrize(
    ("error", "names"),
    [
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), ("RLIMIT_NPROC", "ulimit -u")),
        (RuntimeError("can't start new thread"), ("RLIMIT_NPROC", "TasksMax=")),
        (OSError(errno.EFBIG, "File too large"), ("RLIMIT_FSIZE", "LimitFSIZE=")),
        (OSError(errno.EMFILE, "Too many open files"), ("RLIMIT_NOFILE", "ulimit -n")),
        (MemoryError(), ("private memory", "no limit is set", "ulimit -d")),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), ("private memory", "ulimit -d and -v")),
        (ImportError("libfoo.so: failed to map segment from shared object"), ("private memory",)),
    ],
)
def test_a_limit_is_named(error: Exception, names: tuple[str, ...]) -> None:
    limit = limit_behind(error)
    assert limit is not None
    for name in names:
        assert name in f"{limit.message} {limit.hint}"


@pytest.mark.parametrize(
    "error", [OSError(errno.EIO, "x"), RuntimeError("no"), ImportError("no module"), ValueError("EAGAIN")]
)
def test_other_errors_come_of_no_limit(error: Exception) -> None:
    assert limit_behind(error) is None


def test_its_value_is_that_of_the_process() -> None:
    code = (
        "import errno, resource; from shmmap.segment.process_limits import limit_behind, file_size_limit\n"
        "assert file_size_limit() == 4096\n"
        "print(limit_behind(OSError(errno.EFBIG, '')).message)\n"
        "print(limit_behind(RuntimeError('can\\'t start new thread')).message)"
    )

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30))

    done = subprocess.run(
        [sys.executable, "-c", code], preexec_fn=limit, capture_output=True, text=True, check=True
    )
    size, threads = done.stdout.splitlines()
    assert size.endswith("RLIMIT_FSIZE is 4,096 bytes")
    assert threads.endswith("1024 MiB of data (RLIMIT_DATA)"), "a thread's stack is part of it"
