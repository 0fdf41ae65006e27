# SPDX-License-Identifier: Apache-2.0
"""Interrupts at the wrong moment: handlers of signals are as before, and none is lost."""

from __future__ import annotations

import signal
import subprocess
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


PROGRAM = """\
import os, signal, sys, time, weakref
from shmmap.cli.program import interrupts_kept

class Thing:
    def __del__(self):
        if "finalizer" in sys.argv:
            signal.raise_signal(number)

def callback(_):
    if "callback" in sys.argv:
        signal.raise_signal(number)

def stop(*_):
    raise SystemExit(7)

def dictionary():
    found = weakref.WeakValueDictionary()
    one = found[1] = Thing()
    return found, one

number = signal.SIGTERM if "stop" in sys.argv else signal.SIGINT
signal.signal(signal.SIGTERM, stop)
with interrupts_kept():
    for _ in range(2 if "twice" in sys.argv else 1):
        try:
            thing = Thing()
            watched = weakref.ref(thing, callback)
            del thing
            os.write(1, b"ignored ")
            time.sleep(30)
        except (KeyboardInterrupt, SystemExit) as error:
            os.write(1, type(error).__name__.encode() + b" ")
"""


AT_ONCE = """\
from shmmap.cli import program
program._LATER_S = 1e-6
"""


@pytest.mark.parametrize("where", ["finalizer", "callback"])
@pytest.mark.parametrize("what", ["interrupt", "stop"])
@pytest.mark.parametrize("times", ["once", "twice"])
@pytest.mark.parametrize("machine", ["idle", "busy"])
def test_what_was_ignored_comes_again(where: str, what: str, times: str, machine: str) -> None:
    """On a busy machine "a moment later" comes before this process goes on."""
    program = PROGRAM if machine == "idle" else AT_ONCE + PROGRAM
    done = subprocess.run(
        [sys.executable, "-c", program, where, what, times], capture_output=True, text=True, timeout=60
    )
    raised = "KeyboardInterrupt" if what == "interrupt" else "SystemExit"
    assert done.stdout.split() == ["ignored", raised] * (2 if times == "twice" else 1)
    assert done.stderr == ""


AT_THE_END = """\
import signal
from shmmap.cli import program
program._LATER_S = 60.0

class Thing:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

with program.interrupts_kept():
    Thing()
    assert signal.getitimer(signal.ITIMER_REAL)[0] > 0
assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
"""


def test_what_was_ignored_last_does_not_come_at_the_interpreters_end() -> None:
    """No handler would be there any more, and the alarm end the process."""
    done = subprocess.run([sys.executable, "-c", AT_THE_END], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_other_exceptions_are_reported_as_before() -> None:
    program = PROGRAM.replace("signal.raise_signal(number)", "raise ValueError('odd')").replace("30", "0")
    done = subprocess.run(
        [sys.executable, "-c", program, "finalizer"], capture_output=True, text=True, timeout=60
    )
    assert "ValueError: odd" in done.stderr


AT_A_MOMENT = """\
import atexit, signal, sys
from shmmap.cli import main

moment = sys.argv[1]

class At:
    def find_spec(self, name, *_):
        if name == moment:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, At())
if moment == "exit":
    atexit.register(signal.raise_signal, signal.SIGINT)
if "ignored" in sys.argv:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
sys.argv = ["shmmap", "status", "--help"]
main()
"""


@pytest.mark.parametrize("moment", ["shmmap.cli.entry", "shmmap.cli.verbs.look.status", "exit"])
def test_ctrl_c_before_and_after_a_verb_says_nothing(moment: str) -> None:
    """Python would print a traceback; where a shell has it ignored, it stays so."""
    words = [sys.executable, "-c", AT_A_MOMENT, moment]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")
    assert bool(done.stdout) == (moment == "exit")
    done = subprocess.run([*words, "ignored"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: shmmap status")
