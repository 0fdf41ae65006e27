# SPDX-License-Identifier: Apache-2.0
"""Which descriptors are open, also when there is none left to find out with."""

from __future__ import annotations

import os
import resource

from shmmap.daemon.transport.crowd_control import memory_bytes
from shmmap.daemon.transport.own_sockets import open_descriptors


def test_when_no_descriptor_is_left() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    before = open_descriptors()
    highest = max(before)
    taken: list[int] = []
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 8, hard))
        while True:
            try:
                taken.append(os.open("/dev/null", os.O_RDONLY))
            except OSError:  # noqa: PERF203
                break
        found, memory = open_descriptors(), memory_bytes()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for fd in taken:
            os.close(fd)
    assert found == list(range(highest + 8))
    assert memory == 0
    assert memory_bytes() > 1 << 20
