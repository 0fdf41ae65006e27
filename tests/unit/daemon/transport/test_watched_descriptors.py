# SPDX-License-Identifier: Apache-2.0
"""Descriptors that the serving loop watches."""

from __future__ import annotations

import os

from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors


class Owner:
    """Has a descriptor open as long as it is."""

    def __init__(self) -> None:
        self.fd = os.eventfd(0, os.EFD_CLOEXEC)

    def __del__(self) -> None:
        os.close(self.fd)

    def look(self) -> None:
        """Do nothing."""


def test_what_only_its_callback_keeps_open_can_be_unwatched() -> None:
    watched, owner = WatchedDescriptors(), Owner()
    fd = owner.fd
    watched.watch(fd, owner.look)
    del owner
    os.eventfd_write(fd, 1)
    assert watched.poll(0.0) == [fd]
    watched.unwatch(fd)
    assert watched.poll(0.0) == []
    watched.close()
