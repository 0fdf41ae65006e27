# SPDX-License-Identifier: Apache-2.0
"""The daemon that users test with, what only our own tests do to it, and waiting for it."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar

from shmmap.events import EventStream
from shmmap.protocol import events as e
from shmmap.statistics.reader import read_statistics
from shmmap.testing import daemon_process
from shmmap.testing.daemon_process import (
    READY_S,
    STOP_S,
    open_files,
    processes_marked,
    wait_ended,
    wait_readable,
)
from tests.support.forked_programs import ROOT, fork_program

__all__ = [
    "READY_S",
    "ROOT",
    "STOP_S",
    "TIMEOUT_S",
    "DaemonProcess",
    "Deadline",
    "LineProcess",
    "counters",
    "first_answer",
    "next_reload",
    "open_files",
    "processes_marked",
    "standing_still",
    "stop",
    "until",
    "wait_ended",
    "wait_readable",
]

_Answer = TypeVar("_Answer")


def _stat(pid: int) -> list[str]:
    """State, parent and more of a process, see proc(5)."""
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()


def _parent_of(pid: int) -> int:
    return int(_stat(pid)[1])


def stop(pid: int) -> None:
    """SIGSTOP a process, and wait until it stands still."""
    os.kill(pid, signal.SIGSTOP)
    until(lambda: _stat(pid)[0] == "T")


class DaemonProcess(daemon_process.DaemonProcess):
    """The daemon of this tree, whatever is installed.

    Parameters
    ----------
    forked
        Whether it may be a fork of a process that has imported it; for what an interpreter's start decides
        (memory, modules, the command line in ``/proc``) it may not.
    """

    def __init__(self, map_path: Path | str, *arguments: str, forked: bool = True, **options: Any) -> None:
        super().__init__(map_path, *arguments, **options)
        self._forked = forked
        self.environment["PYTHONPATH"] = str(ROOT)
        self.environment.update(options.get("environment") or {})

    def _run(
        self, command: Sequence[str], environment: Mapping[str, str], log: IO[bytes]
    ) -> subprocess.Popen[bytes]:
        if self._forked and not self.command and not self.pass_fds:
            _, _, module, *words = command
            if (process := fork_program(module, words, environment, log)) is not None:
                return process
        return super()._run(command, environment, log)

    def give_to(self, uid: int) -> None:
        """Let the daemon run as another user: its directories become that user's."""
        for path in (self.runtime_dir, self.shm_dir, self.scratch_dir):
            os.chown(path, uid, -1)
            for name in os.listdir(path):
                os.chown(f"{path}/{name}", uid, -1)

    def run_to_end(self, timeout_s: float = READY_S) -> int:
        """Run a daemon that is expected to end by itself; returns its exit code."""
        process = self.spawn()
        try:
            return process.wait(timeout_s)
        finally:
            process.kill()
            process.wait()

    def loaders(self) -> list[int]:
        """Ids of the loaders, without their parent's."""
        return [pid for pid in self.children() if _parent_of(pid) != self.pid]

    def send(self, number: signal.Signals) -> None:
        """Send a signal; after SIGSTOP it stands still."""
        super().send(number)
        if number == signal.SIGSTOP:
            stop(self.pid)

    def loaders_parent(self) -> int:
        """Id of the process that loaders are forked from."""
        (found,) = set(self.children()) - set(self.loaders())
        return found

    def stop_loaders(self) -> list[int]:
        """SIGSTOP every loader there is, wait until they stand still; returns their ids."""
        loaders = self.loaders()
        for pid in loaders:
            stop(pid)
        return loaders

    def until_segments(self, at_most: int, ask: Callable[[], object]) -> None:
        """Ask until no more are left (the daemon looks at retired ones by itself)."""
        waiting = Deadline()
        while waiting(len(self.segments()) > at_most):
            ask()


class LineProcess:
    """A program that is written lines and prints some; killed at the end of its ``with`` block."""

    def __init__(self, *command: str | Path, **options: Any) -> None:
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, **options
        )

    def __enter__(self) -> LineProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    def read(self) -> str:
        """Wait for the next line; it may not have ended."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, f"it ended with {self.process.wait()}"
        return str(line).rstrip("\n")

    def write(self, line: str = "") -> None:
        """Send a line."""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def end(self) -> None:
        """Close its input, and wait for its end."""
        self.process.communicate(timeout=30)

    def kill(self) -> None:
        """End it now, whatever it does, and wait for its end."""
        self.process.kill()
        self.process.communicate()


# A limit for loops that ask until something has happened: a defect fails one test, not the whole run


LIMIT_S = 240.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.0005, 0.016


class Deadline:
    """``while waiting(not_yet): ask()``, with ``waiting = Deadline()`` before the loop.

    Between two questions it pauses, 0.5 ms at first and then longer: what is waited for has the processor.
    """

    def __init__(self) -> None:
        self._end_s = time.monotonic() + LIMIT_S
        self._pause_s = FIRST_PAUSE_S

    def __call__(self, not_yet: bool, why: Callable[[], str] = str) -> bool:
        """Return ``not_yet``; AssertionError, which says why, once that has been so for too long."""
        if not_yet:
            assert time.monotonic() < self._end_s, f"it did not happen within {LIMIT_S:.0f} s. {why()}"
            time.sleep(self._pause_s)
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
        return not_yet


# Waiting for what a daemon does by itself: by its events and statistics, not for a time


TIMEOUT_S = 60.0


def until(done: Callable[[], object], why: Callable[[], str] = str) -> None:
    """Wait until something is so; ``why`` says what is instead."""
    first_answer(done, bool, why)


def first_answer(
    ask: Callable[[], _Answer], fits: Callable[[_Answer], object], why: Callable[[], str] = str
) -> _Answer:
    """Ask until an answer fits, and return that one; ``why`` says what is instead."""
    waiting = Deadline()
    while waiting(not fits(answer := ask()), why):
        pass
    return answer


@contextmanager
def standing_still(one: DaemonProcess) -> Iterator[None]:
    """The loaders stand still meanwhile."""
    stopped = one.stop_loaders()
    try:
        yield
    finally:
        for pid in stopped:
            os.kill(pid, signal.SIGCONT)


def counters(one: DaemonProcess) -> dict[str, int]:
    """What its statistics say now."""
    return dict(read_statistics(one.instance, one.shm_dir).counters)


def next_reload(stream: EventStream) -> e.Reloaded:
    """Wait until the map has been read again."""
    while True:
        happening = stream.next(60.0)
        assert happening is not None, "there was no event of a reload"
        if isinstance(happening, e.Reloaded):
            return happening
