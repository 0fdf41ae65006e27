# SPDX-License-Identifier: Apache-2.0
"""The names of an instance, and how they are taken away by what is on disk alone."""

from __future__ import annotations

import contextlib
import os

from shmmap.daemon.host.signals import StartSignals
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import segment_prefix, statistics_name
from shmmap.statistics.exclusive_name import has_writer

__all__ = ["lock_path", "stopped_early", "take_away"]


def lock_path(socket_path: str) -> str:
    """Return the path of the lock that says whose the request socket is."""
    return socket_path.removesuffix(".sock") + ".lock"


def take_away(directory: ShmDirectory, instance: str) -> None:
    """Remove the instance's names."""
    for name in directory.names(segment_prefix(instance)):
        with contextlib.suppress(OSError):
            os.unlink(directory.path + name)


def stopped_early(
    signals: StartSignals,
    directory: ShmDirectory,
    instance: str,
    kind: type[BaseException] | None,
    *_: object,
) -> None:
    """A stop empties, even one that came before there was anything but what an earlier life left.

    Unless a daemon with another runtime directory has begun to serve from these names meanwhile.
    """
    if kind is SystemExit and not signals.keep and not has_writer(directory, statistics_name(instance)):
        take_away(directory, instance)
