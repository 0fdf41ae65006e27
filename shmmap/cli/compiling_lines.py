# SPDX-License-Identifier: Apache-2.0
"""Lines on stderr about what takes long: kernels being compiled, here or by the daemon, and layers there."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Final

from shmmap.errors import ShmmapError
from shmmap.lacking import PREPARE_HINT
from shmmap.quantities import counted

if TYPE_CHECKING:
    from shmmap.client.client import Client
    from shmmap.statistics.reader import Snapshot

_PAUSE_S: Final = 5.0
_LOOK_S: Final = 0.5
_LONG_S: Final = 3.0
"""How long a wait is until it is said how far the daemon is."""


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
def saying_what_the_daemon_does(client: Client) -> Iterator[None]:
    """Print what the daemon does while the block waits for layers: compiling kernels, then how far it is."""
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
    began: Mapping[str, int] | None = None
    compiles, hinted, due_s = False, False, time.monotonic() + _LONG_S
    while not ended.wait(_LOOK_S):
        try:
            counts = read().counters
        except (ShmmapError, OSError):
            return
        began = began or counts
        if counts.get("loaders_compiling", 0) and not compiles:
            compiles = True
            _say("shmmap: the daemon compiles kernels for this layer, once for this version")
        now_s = time.monotonic()
        if now_s < due_s or compiles:
            continue
        due_s = now_s + _PAUSE_S
        loaded, computed = (counts[name] - began[name] for name in ("loads_finished", "layers_computed"))
        _say(
            f"shmmap: {counted(loaded, 'load')} done, {computed:,} computed, {counts['load_queue']:,} waiting"
            f" for {counted(counts['workers'], 'loader')}"
        )
        if computed and not hinted:
            hinted = True
            _say(f"hint: {PREPARE_HINT}")


def _say(line: str) -> None:
    from shmmap.cli.screens.output import print_line  # takes 5 ms to import: only where kernels are compiled

    print_line(line, file=sys.stderr, flush=True)
