# SPDX-License-Identifier: Apache-2.0
"""The names of an instance, and how they are taken away by what is on disk alone."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable

from shmmap.daemon.host.signals import StartSignals
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.names import segment_prefix

__all__ = ["lock_name", "lock_path", "stopped_early", "take_away"]


def lock_name(instance: str) -> str:
    """Return the name of the lock that says whose the instance's names are."""
    return segment_prefix(instance) + "lock"


def lock_path(socket_path: str) -> str:
    """Return the path of the lock that says whose the request socket is."""
    return socket_path.removesuffix(".sock") + ".lock"


def take_away(directory: ShmDirectory, instance: str, more: Iterable[str] = ()) -> None:
    """Remove the instance's names, then the files ``more``; all but its lock, which goes last."""
    names = [name for name in directory.names(segment_prefix(instance)) if name != lock_name(instance)]
    for path in (*(directory.path + name for name in names), *more):
        with contextlib.suppress(OSError):
            os.unlink(path)


def stopped_early(
    signals: StartSignals,
    directory: ShmDirectory,
    instance: str,
    kind: type[BaseException] | None,
    *_: object,
) -> None:
    """A stop empties, even one that came before there was anything but what an earlier life left."""
    if kind is SystemExit and not signals.keep:
        take_away(directory, instance)
