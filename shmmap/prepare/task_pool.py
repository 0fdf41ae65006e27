# SPDX-License-Identifier: Apache-2.0
"""Runs tasks on cells in worker processes, so that a hostile file fails only its cell, not the run.

The kernel ends the workers with this process.  If a worker dies, another one replaces it and gets its tasks
again, each alone; a task fails only if a second worker dies of it.  Each packet is one message.  Publishing
uses the same tasks.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, Generic, Protocol, TypeAlias, TypeVar

import msgspec

from shmmap.errors import InternalError
from shmmap.layers.sources import Neighbour
from shmmap.processes.start_child import MAX_PACKET_BYTES, how_ended, start_child
from shmmap.segment.version import Source


class CellTask(msgspec.Struct, array_like=True, tag="cell"):
    """Task to make layers of a cell; ``around`` lists, for each layer, the neighbours it uses."""

    number: int
    cell_id: str
    source: Source
    box: tuple[float, float, float, float]
    frame_id: str
    layers: tuple[str, ...]
    around: tuple[tuple[Neighbour, ...], ...]


class LayerDone(msgspec.Struct, array_like=True):
    """Result for one layer: ``how`` is kept (it was in the cache), recognised, built or failed."""

    layer: str
    how: str
    bytes: int = 0
    message: str = ""


class CellDone(msgspec.Struct, array_like=True, tag="done"):
    """Message that a cell is done, with a result for each layer."""

    number: int
    layers: tuple[LayerDone, ...]


class Ready(msgspec.Struct, array_like=True, tag="ready"):
    """Message that a worker has started."""


FromWorker: TypeAlias = CellDone | Ready

encode: Final = msgspec.msgpack.Encoder().encode
_task: Final[msgspec.msgpack.Decoder[CellTask]] = msgspec.msgpack.Decoder(CellTask)
_done: Final[msgspec.msgpack.Decoder[FromWorker]] = msgspec.msgpack.Decoder(FromWorker)
decode_task: Final = _task.decode
"""Decodes a message to a worker."""
decode_done: Final = _done.decode
"""Decodes a message from a worker."""


_FAILED_STARTS: Final = 3


class _Numbered(Protocol):
    number: int


_Task = TypeVar("_Task", bound=_Numbered)
_Done = TypeVar("_Done", bound=_Numbered)


@dataclass(eq=False, slots=True)
class _Worker(Generic[_Task]):
    process: subprocess.Popen[bytes]
    channel: socket.socket
    tasks: dict[int, _Task] = field(default_factory=dict)
    ready: bool = False


class TaskPool(Generic[_Task, _Done]):
    """Runs tasks in worker processes; each task has a unique number.

    Parameters
    ----------
    module, arguments
        Module that a worker runs, see `start_child`.  It sends `Ready`, then one message for each task.
    workers
        Maximum number of processes.
    decode
        Decodes a worker's message.
    finished
        Called with each task and its message.
    died
        Called with a task of which two workers died, and a description of the second crash.
    ahead
        Number of tasks assigned to a worker at a time, so that it need not wait for the next one.
    """

    def __init__(
        self,
        module: str,
        arguments: list[str],
        *,
        workers: int,
        decode: Callable[[bytes], _Done | Ready],
        finished: Callable[[_Task, _Done], None],
        died: Callable[[_Task, str], None],
        ahead: int = 1,
    ) -> None:
        self._module = module
        self._arguments = arguments
        self._limit = workers
        self._decode = decode
        self._finished = finished
        self._died = died
        self._ahead = ahead
        self._tasks: Iterator[_Task] = iter(())
        self._again: list[_Task] = []
        self._suspects: set[int] = set()
        self._selector = selectors.DefaultSelector()
        self._workers: list[_Worker[_Task]] = []
        self._failed_starts = 0

    def run(self, tasks: Iterator[_Task]) -> None:
        """Run all tasks.

        Raises
        ------
        InternalError
            No worker can be started.
        """
        self._tasks = tasks
        try:
            while True:
                while len(self._workers) < self._limit and (task := self._next()) is not None:
                    self._start(task)
                if not self._workers or not any(worker.tasks for worker in self._workers):
                    break
                for key, _ in self._selector.select():
                    self._receive(key.data)
        finally:
            for worker in list(self._workers):
                self._end(worker)
            self._selector.close()

    def _next(self) -> _Task | None:
        """Return the next task: one returned by a dead worker, or a new one; None if there is none."""
        return self._again.pop() if self._again else next(self._tasks, None)

    def _start(self, task: _Task) -> None:
        process, ours = start_child(self._module, *self._arguments, new_session=False)
        worker: _Worker[_Task] = _Worker(process, ours)
        self._workers.append(worker)
        self._selector.register(ours, selectors.EVENT_READ, worker)
        self._give(worker, task)

    def _give(self, worker: _Worker[_Task], task: _Task) -> None:
        worker.tasks[task.number] = task
        with contextlib.suppress(OSError):  # the channel reports a dead worker
            worker.channel.send(encode(task))

    def _fill(self, worker: _Worker[_Task]) -> None:
        while len(worker.tasks) < self._ahead and (task := self._next()) is not None:
            self._give(worker, task)

    def _receive(self, worker: _Worker[_Task]) -> None:
        try:
            data = worker.channel.recv(MAX_PACKET_BYTES)
            message = self._decode(data) if data else None
        except (OSError, msgspec.MsgspecError):
            message = None
        if message is None:
            self._lost(worker)
        elif isinstance(message, Ready):
            worker.ready = True
            self._failed_starts = 0
            self._fill(worker)
        else:
            self._finished(worker.tasks.pop(message.number), message)
            self._fill(worker)

    def _lost(self, worker: _Worker[_Task]) -> None:
        how = self._end(worker)
        tasks = list(worker.tasks.values())
        if not worker.ready:
            self._failed_starts += 1
            if self._failed_starts >= _FAILED_STARTS:
                raise InternalError(f"no worker can be started: {how}")
            self._again += tasks
        elif len(tasks) == 1 and tasks[0].number in self._suspects:
            self._died(tasks[0], how)
        else:  # the culprit is found by giving each task alone to a worker
            self._ahead = 1
            self._suspects.update(task.number for task in tasks)
            self._again += tasks

    def _end(self, worker: _Worker[_Task]) -> str:
        self._workers.remove(worker)
        self._selector.unregister(worker.channel)
        worker.channel.close()
        worker.process.kill()
        return how_ended(worker.process.wait())
