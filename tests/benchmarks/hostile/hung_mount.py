# SPDX-License-Identifier: Apache-2.0
"""A file system that hangs, as a network mount whose server is gone: whoever looks into it waits."""

from __future__ import annotations

import contextlib
import ctypes
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

from tests.benchmarks.hostile.report import LeftOut

__all__ = ["hung_mount"]


@contextlib.contextmanager
def hung_mount(path: Path) -> Iterator[Path]:
    """Mount one; at the end of the block everybody who waits in it gets an error.

    It is a FUSE mount whose server, this process, never reads a request.
    """
    path.mkdir()
    try:
        fd = os.open("/dev/fuse", os.O_RDWR | os.O_CLOEXEC)
    except OSError as error:
        raise LeftOut(f"no FUSE here: {error.strerror}") from None
    libc = ctypes.CDLL(None, use_errno=True)
    options = f"fd={fd},rootmode=40000,user_id={os.getuid()},group_id={os.getgid()},allow_other"
    try:
        if libc.mount(b"hung", os.fsencode(path), b"fuse", 0, options.encode()):
            raise LeftOut(f"cannot mount with FUSE: {os.strerror(ctypes.get_errno())}")
    except LeftOut:
        os.close(fd)
        raise
    try:
        yield path
    finally:
        os.close(fd)  # ends the connection, and with it all waiting
        subprocess.run(["umount", "-l", str(path)], check=True)
