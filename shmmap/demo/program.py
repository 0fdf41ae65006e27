# SPDX-License-Identifier: Apache-2.0
"""Run the programs of a demonstration, measure them, show progress, and leave none running.

The kernel counts memory and processor time (``/proc/PID/smaps_rollup`` and ``/proc/PID/stat``).  *PSS*
(proportional set size) divides every shared page among the processes that map it, so that the PSS of several
processes can be summed.  A page of shared memory that no process maps is in memory, but in no process's PSS.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final

from shmmap.errors import InternalError
from shmmap.processes.interrupts import interrupts_later
from shmmap.testing.daemon_process import wait_readable, without_settings

_LAST_WORDS: Final = 2000  # characters of stderr
_USER: Final = 11  # utime, stime, cutime, cstime: their place in proc(5), counted after the command
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")


class Progress:
    """Progress that shows nothing; the command line has subclasses that do."""

    def stage(self, text: str, total: int) -> None:
        """Begin a stage of ``total`` steps."""

    def step(self, *lines: str) -> None:
        """Count a step of the stage; ``lines`` describe the state after it."""

    def event(self, text: str) -> None:
        """Show an event."""


class Program:
    """A process ``python -m MODULE WORD...`` with pipes to its stdin and from its stdout.

    Parameters
    ----------
    name
        Name in error messages.
    module, words
        Module and command line.
    work
        Directory for the program's stderr.

    Attributes
    ----------
    exit_code
        Exit code, set by `finish`.

    Used as a context manager, the program is started on entry.  On exit it is killed with all its
    descendants, if it still runs.  Ctrl-C does not reach it.

    Raises
    ------
    InternalError
        From methods: the program ended too early, or took too long; the message contains the end of its
        stderr.
    """

    def __init__(self, name: str, module: str, words: Sequence[str], work: Path) -> None:
        self.name = name
        self._command = [sys.executable, "-m", module, *words]
        self._err = work / f"{name}.err"
        self._process: subprocess.Popen[bytes] | None = None
        self._unread = b""
        self.exit_code = 0

    def __enter__(self) -> Program:
        try:
            self.start()
        except BaseException:
            self.kill()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()

    @property
    def pid(self) -> int:
        """Process id of the program.

        Raises
        ------
        InternalError
            The program does not run.
        """
        return self._started.pid

    @property
    def running(self) -> bool:
        """Whether the program was started and has not ended."""
        return self._process is not None and self._process.poll() is None

    @property
    def _started(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            raise InternalError(f"{self.name} does not run")
        return self._process

    def start(self) -> None:
        """Start the program, or start it again after it has ended."""
        self._unread = b""
        with open(self._err, "wb") as err, interrupts_later():
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=err,
                env=without_settings(),
                start_new_session=True,
            )

    def write_line(self, line: str | bytes) -> None:
        """Write a line to the program's stdin."""
        stdin = self._started.stdin
        assert stdin is not None  # noqa: S101  it is a pipe
        try:
            stdin.write((line.encode() if isinstance(line, str) else line) + b"\n")
            stdin.flush()
        except BrokenPipeError:
            raise self._ended_early() from None

    def read_line(self, timeout_s: float) -> str:
        """Return the next line of the program's stdout."""
        for line in self.lines(timeout_s):
            return line
        raise self._ended_early()

    def lines(self, timeout_s: float) -> Iterator[str]:
        """Yield the lines of stdout until the program ends, with at most ``timeout_s`` between two lines."""
        stdout = self._started.stdout
        assert stdout is not None  # noqa: S101  it is a pipe
        while True:
            while b"\n" not in self._unread:
                if not wait_readable([stdout.fileno()], timeout_s):
                    raise InternalError(f"{self.name} wrote nothing for {timeout_s:g} s: {self.last_words()}")
                piece = os.read(stdout.fileno(), 1 << 16)
                if not piece:
                    return
                self._unread += piece
            line, _, self._unread = self._unread.partition(b"\n")
            yield line.decode()

    def finish(self, timeout_s: float, *, fails: bool = False) -> str:
        """Wait for the program to end; return the unread rest of its stdout.

        Parameters
        ----------
        timeout_s
            Longest time between two lines, and from the last line to the end.
        fails
            Whether an exit code other than 0 is allowed.
        """
        text = "\n".join(self.lines(timeout_s))
        try:
            self.exit_code = self._started.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise InternalError(
                f"{self.name} does not end within {timeout_s:g} s: {self.last_words()}"
            ) from None
        self._close_pipes()
        if self.exit_code and not fails:
            raise InternalError(f"{self.name} ended with {self.exit_code}: {self.last_words()}")
        return text

    def kill(self) -> None:
        """Kill the program and all its descendants with SIGKILL."""
        with interrupts_later():
            if self._process is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
                self._close_pipes()

    def last_words(self) -> str:
        """Return the end of the program's stderr."""
        return self._err.read_text(encoding="utf-8", errors="replace")[-_LAST_WORDS:].strip()

    def _close_pipes(self) -> None:
        for pipe in (self._started.stdin, self._started.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self._process = None

    def _ended_early(self) -> InternalError:
        return InternalError(f"{self.name} ended early: {self.last_words()}")


@dataclass(frozen=True, slots=True)
class ProcessMemory:
    """Memory of one process.

    Attributes
    ----------
    own_bytes
        Proportional set size without shared memory: interpreter, share of libraries, heap.
    private_bytes
        Bytes in pages that no other process maps.
    """

    own_bytes: int
    private_bytes: int


def process_memory(pid: int) -> ProcessMemory:
    """Read the memory of one process.

    Raises
    ------
    ProcessLookupError, FileNotFoundError
        The process has ended.
    PermissionError
        The process belongs to another user.
    """
    fields: dict[str, int] = {}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()[1:]:
        name, value = line.split(":")
        fields[name] = int(value.split()[0]) * 1024
    return ProcessMemory(
        own_bytes=fields["Pss"] - fields.get("Pss_Shmem", 0),  # since Linux 5.9
        private_bytes=fields["Private_Clean"] + fields["Private_Dirty"],
    )


def cpu_seconds(pids: Iterable[int]) -> float:
    """Return the user and system time of processes, and of their children that have ended, seconds.

    Raises
    ------
    ProcessLookupError, FileNotFoundError
        One of the processes has ended.
    """
    ticks = 0
    for pid in pids:
        ticks += sum(int(field) for field in _stat(pid)[_USER : _USER + 4])
    return ticks / _TICKS_PER_S


def descendants(pid: int) -> list[int]:
    """Return ``pid`` and the ids of all its living descendants, ascending."""
    children: dict[int, list[int]] = {}
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            state, parent = _stat(int(entry))[:2]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if state != "Z":
            children.setdefault(int(parent), []).append(int(entry))
    found, waiting = [], [pid]
    while waiting:
        current = waiting.pop()
        found.append(current)
        waiting.extend(children.get(current, ()))
    return sorted(found)


def _stat(pid: int) -> list[str]:
    """Return the fields of ``stat`` after the command, which may contain blanks and brackets."""
    stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    return stat[stat.rindex(")") + 2 :].split()
