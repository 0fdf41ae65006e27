# SPDX-License-Identifier: Apache-2.0
"""A program beside the demonstration, in a process of its own that cannot be left behind."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from shmmap.errors import InternalError
from shmmap.processes.interrupts import interrupts_later
from shmmap.testing.environment import without_settings
from shmmap.testing.process_watch import wait_readable

__all__ = ["Program"]

_LAST_WORDS: Final = 2000


class Program:
    """``python -m MODULE WORD...``, and what it says.

    Parameters
    ----------
    name
        What it is called where it fails.
    module, words
        What is started.
    work
        Directory for what it writes.
    piped
        Whether stdout is read while it runs, see `lines`, and not in the end, see `document`.
    fed
        Whether it reads lines from stdin, see `tell`.
    own_session
        Whether a Ctrl-C is kept from it, and it is ended with all that it has started.

    Used as a context manager it is started on entry; on exit it is killed, with all it has started, if it
    has not ended.
    """

    def __init__(
        self,
        name: str,
        module: str,
        words: Sequence[str],
        work: Path,
        *,
        piped: bool = False,
        fed: bool = False,
        own_session: bool = True,
    ) -> None:
        self.name = name
        self._command = [sys.executable, "-m", module, *words]
        self._piped, self._fed, self._own_session = piped, fed, own_session
        self._out, self._err = work / f"{name}.out", work / f"{name}.err"
        self._process: subprocess.Popen[bytes] | None = None

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
    def pid(self) -> int | None:
        """Its process id, None when it does not run."""
        return self._process.pid if self._process is not None else None

    @property
    def running(self) -> bool:
        """Whether it was started and has not ended."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start it, maybe once more."""
        with open(self._out, "wb") as out, open(self._err, "wb") as err, interrupts_later():
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE if self._fed else subprocess.DEVNULL,
                stdout=subprocess.PIPE if self._piped else out,
                stderr=err,
                env=without_settings(),
                start_new_session=self._own_session,
            )

    def tell(self, line: str) -> None:
        """Write a line to the stdin of a ``fed`` one.

        Raises
        ------
        InternalError
            It has ended.
        """
        if self._process is None or self._process.stdin is None:
            raise InternalError(f"{self.name} hears nobody")
        try:
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise InternalError(f"{self.name} ended early: {self.last_words()}") from None

    def tell_no_more(self) -> None:
        """End the stdin of a ``fed`` one."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()

    def lines(self, patience_s: float) -> Iterator[str]:
        """What a ``piped`` one writes to stdout, line by line, until it ends.

        Raises
        ------
        InternalError
            It has written nothing for ``patience_s``.
        """
        if self._process is None or self._process.stdout is None:
            raise InternalError(f"nobody listens to {self.name}")
        out = self._process.stdout.fileno()
        rest = b""
        while True:
            if not wait_readable([out], patience_s):
                raise InternalError(f"{self.name} says nothing for {patience_s:g} s: {self.last_words()}")
            piece = os.read(out, 1 << 16)
            if not piece:
                return
            *whole, rest = (rest + piece).split(b"\n")
            for line in whole:
                yield line.decode()

    def wait(self, timeout_s: float) -> int:
        """Wait for its end; returns its exit code.

        Raises
        ------
        InternalError
            It takes longer.
        """
        if self._process is None:
            raise InternalError(f"{self.name} was not started")
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise InternalError(
                f"{self.name} takes longer than {timeout_s:g} s: {self.last_words()}"
            ) from None
        self._forget(self._process)
        return code

    def document(self, timeout_s: float) -> tuple[dict[str, Any], int]:
        """Wait for its end; returns the JSON document that it printed, and its exit code.

        Raises
        ------
        InternalError
            It takes longer, or printed none.
        """
        code = self.wait(timeout_s)
        try:
            found = json.loads(self._out.read_text(encoding="utf-8"))
        except ValueError:
            found = None
        if not isinstance(found, dict):
            raise InternalError(f"{self.name} ended with {code}: {self.last_words()}")
        return found, code

    def last_words(self) -> str:
        """The end of what it wrote to stderr."""
        return self._err.read_text(encoding="utf-8", errors="replace")[-_LAST_WORDS:].strip()

    def kill(self) -> None:
        """End it with all that it has started."""
        with interrupts_later():
            if self._process is not None:
                with contextlib.suppress(ProcessLookupError):
                    (os.killpg if self._own_session else os.kill)(self._process.pid, signal.SIGKILL)
                self._process.wait()
                self._forget(self._process)

    def _forget(self, process: subprocess.Popen[bytes]) -> None:
        """It has ended: nobody talks with it any more."""
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self._process = None
