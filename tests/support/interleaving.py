# SPDX-License-Identifier: Apache-2.0
"""What two threads do, interleaved by one, in every order in which the other may come in between."""

from __future__ import annotations

import contextlib
import inspect
import sys
from collections.abc import Callable, Iterator
from types import FrameType, ModuleType
from typing import Any, TypeVar

T = TypeVar("T")


class _WaitsError(BaseException):
    """The lock is held."""


class _Lock:
    """Stands for the lock of an object or a module."""

    def __init__(self) -> None:
        self._is_held = False

    def __enter__(self) -> None:
        if self._is_held:
            raise _WaitsError
        self._is_held = True

    def __exit__(self, *_error: object) -> None:
        self._is_held = False


class _Second:
    """Does the second thread's work before the Nth instruction of a file, or as soon as it need not wait."""

    def __init__(self, file: str, work: Callable[[], object], number: int) -> None:
        self._file, self._work, self.left = file, work, number
        self._is_done = False

    def __call__(self, frame: FrameType, event: str, argument: object) -> Any:
        del argument
        if frame.f_code.co_filename != self._file:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            self.left -= 1
            if self.left <= 0:
                self.work()
        return self

    def work(self) -> None:
        """Do it unless it is done, or has to wait."""
        if not self._is_done:
            with contextlib.suppress(_WaitsError):
                self._work()
                self._is_done = True


def interleaved(
    make: Callable[[], T], first: Callable[[T], object], second: Callable[[T], object], lock: str = "_lock"
) -> Iterator[T]:
    """Yield objects, or a module, with which two threads have worked.

    In each the second one came before another instruction of the first.  What it does until it takes the lock
    it may do several times.

    Parameters
    ----------
    lock
        Attribute with the lock.
    """
    sys._getframe().f_trace_opcodes = True  # Python 3.12 has to know before `sys.settrace`
    tracing, number = sys.gettrace(), 0
    while True:
        number += 1
        one = make()
        setattr(one, lock, _Lock())
        file = inspect.getfile(one if isinstance(one, ModuleType) else type(one))
        other = _Second(file, lambda one=one: second(one), number)  # type: ignore[misc]
        sys.settrace(other)
        try:
            first(one)
        finally:
            sys.settrace(tracing)
        other.work()
        yield one
        if other.left > 0:
            assert number > 1, "is anything traced?"
            return
