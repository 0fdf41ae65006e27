# SPDX-License-Identifier: Apache-2.0
"""Whose turn it is to use a connection: taken and given back whatever exception a signal handler raises."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from types import CodeType, FrameType

from shmmap.errors import BadRequest, NoAnswer

__all__ = ["Turn", "check_not_within", "closed", "out_of_time"]


class Turn:
    """A turn as a context manager that may be waited for so long; entering it later raises `StopIteration`.

    Python runs signal handlers between the steps of its interpreter.  A ``with`` enters its block in the
    same step in which what it calls returns, and leaves it likewise, if that is built in: no handler's
    exception can come when the lock is taken and the block not entered, or left and the lock still taken.
    So entering and leaving are no methods here but built-in functions, which each object has in its slots.
    """

    __slots__ = ("__enter__", "__exit__")

    __enter__: Callable[[], object]
    __exit__: Callable[..., None]

    def __init__(self, lock: threading.Lock, timeout_s: float) -> None:
        # the False of a wait in vain is left out, and there is no next
        self.__enter__ = filter(None, map(lock.acquire, (True,), (timeout_s,))).__next__
        self.__exit__ = lock.__exit__


def closed(what: str, hint: str) -> BaseException:
    """Return the error of a request to what is closed.

    While the interpreter ends, that ends the asking thread silently: nothing waits for it.
    """
    main = threading.main_thread()
    if not main.is_alive() and threading.get_ident() != main.ident:
        return SystemExit()
    return BadRequest(f"this {what} is closed", hint=hint)


def out_of_time(timeout_s: float) -> NoAnswer:
    """Return the error of who waited for a turn in vain."""
    return NoAnswer(
        f"another thread's request was under way for {timeout_s:.3g} s",
        hint="give each thread that waits long a client of its own",
    )


def check_not_within(turns: tuple[CodeType, ...], owner: object) -> None:
    """Refuse a turn inside of a turn: it would wait for itself.

    Parameters
    ----------
    turns
        Methods that have turns.
    owner
        Whose methods they are.

    Raises
    ------
    BadRequest
        This thread is in one of them.
    """
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        if frame.f_code in turns and frame.f_locals.get("self") is owner:
            raise BadRequest(
                "this client is in the middle of a request, which a signal handler has interrupted to use it",
                hint="have the handler set a flag or raise an exception, or use another client there",
            )
        frame = frame.f_back
