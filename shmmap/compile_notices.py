# SPDX-License-Identifier: Apache-2.0
"""Notices that kernels are being compiled: once for each version of shmmap, and a person may wait for it.

A process chooses with `watch` how they are shown; by default the first one is logged.  Compiling itself is in
`shmmap.compiling`, which loads numba; this module loads nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

Watcher: TypeAlias = Callable[[str, int, int], None]
"""Called before a kernel is compiled, with its module, its number there, and how many the module has."""

_logged: list[str] = []


def log_first(module: str, _number: int, of: int) -> None:
    """Log the first notice of this process: a `Watcher`."""
    if not _logged:
        from shmmap.logfmt import log  # takes 5 ms to import; a process that compiles has it

        _logged.append(module)
        log.info("compiling kernels, once for this version", module=module, kernels=of)


_watchers: list[Watcher] = [log_first]


def watch(watcher: Watcher) -> None:
    """Show all further notices of this process in another way."""
    _watchers[:] = [watcher]


def notice(module: str, number: int, of: int) -> None:
    """Note that a kernel is about to be compiled: the ``number``th ``of`` its module's."""
    for watcher in _watchers:
        watcher(module, number, of)
