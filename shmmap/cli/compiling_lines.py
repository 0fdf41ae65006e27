# SPDX-License-Identifier: Apache-2.0
"""Lines on stderr that say that kernels are being compiled, by this process or by the daemon it waits for."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Final

from shmmap.errors import ShmmapError

if TYPE_CHECKING:
    from shmmap.client.client import Client
    from shmmap.statistics.reader import Snapshot

__all__ = ["CompilingLines", "saying_what_the_daemon_compiles"]

_PAUSE_S: Final = 5.0
_LOOK_S: Final = 0.5


class CompilingLines:
    """Watcher of `shmmap.compile_notices`: a line at the first kernel, then every few seconds how far it is.

    Parameters
    ----------
    name
        Name of the program, with which its lines begin.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._due_s = 0.0

    def __call__(self, module: str, number: int, of: int) -> None:
        """Print a line, unless the last one was a moment ago."""
        if (now_s := time.monotonic()) >= self._due_s:
            self._due_s = now_s + _PAUSE_S
            _, _, below = module.partition(".")
            part = below.partition(".")[0] or module  # such as layers, of shmmap.layers.kernels
            _say(f"{self._name}: compiling kernels, once for this version: {part}, {number} of {of}")


@contextlib.contextmanager
def saying_what_the_daemon_compiles(client: Client) -> Iterator[None]:
    """Print a line if the daemon compiles kernels while the block waits for layers."""
    from shmmap.statistics.reader import read_statistics

    ended = threading.Event()
    where = client.welcome.instance, client.welcome.shm_dir
    thread = threading.Thread(target=_look, args=(partial(read_statistics, *where), ended), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _look(read: Callable[[], Snapshot], ended: threading.Event) -> None:
    while not ended.wait(_LOOK_S):
        try:
            found = read()
        except (ShmmapError, OSError):
            return
        if found.counters.get("loaders_compiling", 0):
            _say("shmmap: the daemon compiles kernels for this layer, once for this version")
            return


def _say(line: str) -> None:
    from shmmap.cli.screens.output import print_line  # takes 5 ms to import: only where kernels are compiled

    print_line(line, file=sys.stderr, flush=True)
