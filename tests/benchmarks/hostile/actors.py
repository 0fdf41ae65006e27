# SPDX-License-Identifier: Apache-2.0
"""Processes that play a part in a scene: each runs one function, says something, and is told to end."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Final

from shmmap.processes.end_with_parent import die_with

__all__ = ["Actor", "Orders"]

_SPAWN: Final = multiprocessing.get_context("spawn")
TIMEOUT_S: Final = 300.0


class Orders:
    """What an actor's function is given first."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def say(self, what: Any) -> None:
        """Tell the scene something."""
        self._pipe.send(("said", what))

    def go_on(self, pause_s: float = 0.0) -> bool:
        """Wait ``pause_s`` seconds; False as soon as the scene wants the end."""
        return not self._pipe.poll(pause_s)


def _play(
    parent: int,
    is_bystander: bool,
    pipe: Connection,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
) -> None:
    die_with(parent)
    if not is_bystander:
        os.setsid()  # the scheduler shares processors between sessions: it is nobody's that is measured
    try:
        last = "returned", function(Orders(pipe), *arguments)
    except Exception:
        last = "raised", traceback.format_exc()
    with contextlib.suppress(OSError):  # nobody wants to know any more
        pipe.send(last)


class Actor:
    """A process that runs ``function(orders, *arguments)``; killed where its ``with`` block ends.

    Parameters
    ----------
    is_bystander
        It belongs to those that measure; else it is in a session of its own.
    """

    def __init__(self, function: Callable[..., Any], *arguments: Any, is_bystander: bool = False) -> None:
        self.name = function.__name__
        self._pipe, theirs = _SPAWN.Pipe()
        self._process = _SPAWN.Process(
            target=_play, args=(os.getpid(), is_bystander, theirs, function, arguments), daemon=True
        )
        self._process.start()
        theirs.close()

    def __enter__(self) -> Actor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.join()

    @property
    def pid(self) -> int:
        """Its process id."""
        assert self._process.pid is not None
        return self._process.pid

    def said(self, timeout_s: float = TIMEOUT_S) -> Any:
        """Wait for what it says next, or for what its function returns.

        Raises
        ------
        RuntimeError
            It raised an exception, died, or says nothing for so long.
        """
        return self._next(timeout_s)[1]

    def end(self, timeout_s: float = TIMEOUT_S) -> Any:
        """Tell it to end, and return what its function returns; errors as of `said`."""
        with contextlib.suppress(OSError):  # it has ended by itself
            self._pipe.send("end")
        how = what = None
        while how != "returned":
            how, what = self._next(timeout_s)
        return what

    def _next(self, timeout_s: float) -> tuple[str, Any]:
        try:
            if not self._pipe.poll(timeout_s):
                raise RuntimeError(f"{self.name} says nothing for {timeout_s:g} s")
            how, what = self._pipe.recv()
        except (EOFError, ConnectionResetError):
            raise RuntimeError(f"{self.name} died") from None
        if how == "raised":
            raise RuntimeError(f"{self.name}: {what}")
        return how, what

    def kill(self) -> None:
        """End it now, whatever it does."""
        self._process.kill()
        self._process.join()
