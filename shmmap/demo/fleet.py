# SPDX-License-Identifier: Apache-2.0
"""Several consumer processes that follow one vehicle, step by step."""

from __future__ import annotations

import contextlib
import itertools
import json
import selectors
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import IO, Final, Literal

from shmmap.demo.consumer import TASKS, Pose
from shmmap.errors import InternalError
from shmmap.processes.interrupts import interrupts_later
from shmmap.testing.environment import without_settings

__all__ = ["Fleet", "StepReport"]

_ANSWER_S: Final = 60.0
_STOP_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class StepReport:
    """What one consumer did at one pose.

    Attributes
    ----------
    answer
        What it computed, as a sentence.
    follow_s
        How long a control loop would have waited for the map.
    complete_s
        How long until all new cells were there.
    new, new_bytes
        Cells that were new, and bytes of all their columns.
    cells, points, bytes
        What it holds now.
    current
        Whether all was there that it needed; when it drives on, for the pose before.
    counted
        Points that its control loop has read so far on poses that it drove on from.
    paused_s
        Time since its answer before.
    """

    answer: str
    follow_s: float
    complete_s: float
    new: int
    new_bytes: int
    cells: int
    points: int
    bytes: int
    current: bool
    counted: int
    paused_s: float


class Fleet:
    """Processes of `shmmap.demo.consumer`, which take their tasks in turn.

    Parameters
    ----------
    kind, source
        ``shared`` and the daemon's socket, or ``private`` and the map's directory.
    radius
        Of every consumer's window, metres.
    processes
        How many.
    route
        The way that they will be sent along.

    Used as a context manager: all consumers are ready on entry, and gone on exit.

    Raises
    ------
    InternalError
        A consumer ended or did not answer within a minute; the message holds its last words.
    """

    def __init__(
        self,
        kind: Literal["shared", "private"],
        source: str,
        radius: float,
        processes: int = len(TASKS),
        route: Sequence[Pose] = (),
    ) -> None:
        tasks = list(itertools.islice(itertools.cycle(TASKS), processes))
        self._commands = [
            [sys.executable, "-m", "shmmap.demo.consumer", kind, source, str(radius), task] for task in tasks
        ]
        self._route = [(pose.x, pose.y) for pose in route]
        self._processes: list[subprocess.Popen[str]] = []
        self._complaints: list[IO[str]] = []

    @property
    def pids(self) -> list[int]:
        """Process ids, in the order of the tasks."""
        return [process.pid for process in self._processes]

    def __enter__(self) -> Fleet:
        try:
            for command in self._commands:
                complaints = tempfile.TemporaryFile("w+")
                self._complaints.append(complaints)
                with interrupts_later():
                    process = subprocess.Popen(
                        command,
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        stderr=complaints,
                        text=True,
                        env=without_settings(),
                        start_new_session=True,  # a Ctrl-C is not for them: their stdin ends when we end
                    )
                    self._processes.append(process)
            self._answers()
            self._tell({"route": self._route})
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def move_to(self, pose: Pose, *, drive_on: bool = False) -> list[StepReport]:
        """Send everybody to a pose, wait for all answers, return them in the order of the tasks.

        Parameters
        ----------
        drive_on
            Whether they answer with the cells they have, instead of waiting until none is missing.
        """
        self._tell({**asdict(pose), "drive_on": drive_on})
        return [StepReport(**json.loads(answer)) for answer in self._answers()]

    def _tell(self, order: dict[str, object]) -> None:
        """Send a line to everybody."""
        line = json.dumps(order) + "\n"
        for index, process in enumerate(self._processes):
            assert process.stdin is not None  # noqa: S101  it is a pipe, see above
            try:
                process.stdin.write(line)
                process.stdin.flush()
            except BrokenPipeError:
                raise self._failure(index, "ended") from None

    def stop(self) -> None:
        """End all consumers."""
        with interrupts_later():
            for process in self._processes:
                with contextlib.suppress(BrokenPipeError):
                    if process.stdin is not None:
                        process.stdin.close()
            deadline_s = time.monotonic() + _STOP_S
            for process in self._processes:
                try:
                    process.wait(max(deadline_s - time.monotonic(), 0.0))
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                if process.stdout is not None:
                    process.stdout.close()
            for complaints in self._complaints:
                complaints.close()
            self._processes, self._complaints = [], []

    def _answers(self) -> list[str]:
        """Read one line from everybody."""
        answers: dict[int, str] = {}
        deadline_s = time.monotonic() + _ANSWER_S
        with selectors.DefaultSelector() as waiting:
            for index, process in enumerate(self._processes):
                assert process.stdout is not None  # noqa: S101  it is a pipe
                waiting.register(process.stdout, selectors.EVENT_READ, index)
            while len(answers) < len(self._processes):
                ready = waiting.select(deadline_s - time.monotonic())
                if not ready:
                    silent = min(set(range(len(self._processes))) - set(answers))
                    raise self._failure(silent, f"did not answer within {_ANSWER_S:g} s")
                for key, _ in ready:
                    # whoever writes a line writes it whole, and one only
                    line = self._processes[key.data].stdout.readline()
                    if not line:
                        raise self._failure(key.data, "ended")
                    answers[key.data] = line
                    waiting.unregister(key.fileobj)
        return [answers[index] for index in range(len(self._processes))]

    def _failure(self, index: int, what: str) -> InternalError:
        self._complaints[index].seek(0)
        words = self._complaints[index].read().split("\n")
        last = next((line for line in reversed(words) if line.strip()), "")  # of a traceback: the error
        return InternalError(f"a consumer {what}" + (f": {last}" if last else ""))
