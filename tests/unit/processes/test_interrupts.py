# SPDX-License-Identifier: Apache-2.0
"""Handlers of signals are as they were after the block, wherever a signal falls."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import FrameType
from typing import Any

import pytest

from shmmap.processes.interrupts import ENDINGS, interrupts_later, signals_interrupt


def interrupted_at(number: int, block: Callable[[], AbstractContextManager[None]]) -> bool:
    """Press Ctrl-C in the call of this number; whether it came to that."""
    calls = 0

    def count(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal calls
        if event == "call":
            calls += 1
            if calls == number:
                sys.setprofile(None)
                signal.raise_signal(signal.SIGINT)

    sys.setprofile(count)
    try:
        with block():
            pass
    except KeyboardInterrupt:
        pass
    finally:
        sys.setprofile(None)
    return calls >= number


def handlers() -> list[Any]:
    return [signal.getsignal(number) for number in ENDINGS]


@pytest.mark.parametrize("block", [interrupts_later, signals_interrupt])
def test_an_interrupt_at_any_call_leaves_the_handlers(
    block: Callable[[], AbstractContextManager[None]],
) -> None:
    before = handlers()
    number = 1
    while interrupted_at(number, block):
        assert handlers() == before, number
        number += 1
    assert handlers() == before
    assert number > 12


def test_a_handler_that_is_not_pythons_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    known = signal.getsignal
    monkeypatch.setattr(
        signal, "getsignal", lambda number: None if number == signal.SIGHUP else known(number)
    )
    with interrupts_later():
        assert known(signal.SIGTERM) is not signal.SIG_DFL
        assert known(signal.SIGHUP) is signal.SIG_DFL


def test_what_is_held_back_comes_after_the_block_also_when_it_fails() -> None:
    with pytest.raises(KeyboardInterrupt) as caught, interrupts_later():  # noqa: PT012
        signal.raise_signal(signal.SIGINT)
        raise ValueError
    assert isinstance(caught.value.__context__, ValueError)
