# SPDX-License-Identifier: Apache-2.0
"""Python ignores an interrupt in a callback of a weak reference or in a finalizer; the program does not."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """\
import os, signal, sys, time, weakref
from shmmap.processes.lost_interrupts import keep_interrupts

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

keep_interrupts()
number = signal.SIGTERM if "stop" in sys.argv else signal.SIGINT
signal.signal(signal.SIGTERM, stop)
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
from shmmap.processes import lost_interrupts
lost_interrupts.LATER_S = 1e-6
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


def test_other_exceptions_are_told_as_before() -> None:
    program = PROGRAM.replace("signal.raise_signal(number)", "raise ValueError('odd')").replace("30", "0")
    done = subprocess.run(
        [sys.executable, "-c", program, "finalizer"], capture_output=True, text=True, timeout=60
    )
    assert "ValueError: odd" in done.stderr
