# SPDX-License-Identifier: Apache-2.0
"""The live worker's process: reads the daemon's messages, and runs the turns of each map.

It dies with the daemon.  Whenever it dies, the next worker finds the applied scans in shared memory.
"""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import select
import socket
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import shmmap.live_messages as messages
from shmmap.chunks.chunk_file import usual_codec
from shmmap.errors import BadRequest, ConfigError, InstanceBusy, InternalError, LiveInterrupted, ShmmapError
from shmmap.live_settings import LiveSettings
from shmmap.live_worker.chunk_memory import ChunkMemory, live_prefix
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.map_record import MapSettings
from shmmap.live_worker.marks_directory import MarksDirectory
from shmmap.live_worker.paging.residency import Limits
from shmmap.live_worker.served_map import ServedMap
from shmmap.logfmt import log, set_up_logging
from shmmap.processes.start_child import channel_to_parent, packet_buffer, receive_packet
from shmmap.protocol.codec import decode_request, encode, request_number
from shmmap.protocol.live import LIVE_REQUESTS, LiveList, LiveListed, LiveMapRow
from shmmap.protocol.messages import ErrorReply

STATUS_S: Final = 0.5
MESSAGES_PER_TURN: Final = 16
END_S: Final = 0.2
HOPELESS_S: Final = 10.0
"""At the end, saving stops after this time without a successful write."""
OTHER_DESCRIPTORS: Final = 512
"""Descriptors and mappings reserved for other purposes than chunks."""
LEAST_CHUNKS: Final = 64
LONG_S: Final = 1.0
"""Time of reading a map's files that is reported as a problem; on a slow disk it ends by itself."""
RETRY_S: Final = 1.0
"""Shortest pause after a failed try."""
PAUSE_FACTOR: Final = 4.0
"""Ratio of the pause to the duration of the failed try, so that large maps are not read continuously."""


class _OpeningMap:
    """One map that is being opened: a thread reads its files, since a directory may hang.

    Parameters
    ----------
    wake
        Called in the thread when reading the files has succeeded or failed.

    Attributes
    ----------
    problem
        Why the map is not open; empty while the reason is not known.
    error
        Error of the last try.
    """

    def __init__(self, settings: LiveSettings, budget_bytes: int, wake: Callable[[], None]) -> None:
        self.settings = settings
        self.problem = ""
        self.error: BaseException | None = None
        self._budget_bytes = budget_bytes
        self._wake = wake
        self._begun_s = self._retry_s = 0.0
        self._thread = ThreadPoolExecutor(1, "live-opening")
        self._reading: Future[tuple[Folder, MapDatabase]] | None = None

    def run_turn(self, now_s: float) -> tuple[Folder, MapDatabase] | None:
        """Continue; once the files are read, return the directory and the database of a new run."""
        if self._reading is None:
            if now_s >= self._retry_s:
                self._begun_s = now_s
                self._reading = self._thread.submit(_open_files, self.settings)
                self._reading.add_done_callback(lambda _: self._wake())
            return None
        if not self._reading.done():
            if now_s >= self._begun_s + LONG_S and not self.problem:
                path = self.settings.path
                self._note(f"its files are being read, which takes long: is {path} slow, or does it hang?")
            return None
        read, self._reading = self._reading, None
        if (error := read.exception()) is None:
            return read.result()
        self.failed(error, now_s)
        return None

    def failed(self, error: BaseException, now_s: float) -> None:
        """Record an error of opening as the map's problem until a try succeeds."""
        self.error = error
        self._retry_s = now_s + max(RETRY_S, PAUSE_FACTOR * (now_s - self._begun_s))
        self._note(f"it cannot be opened: {_reason(error)}")

    def _note(self, problem: str) -> None:
        if problem != self.problem:
            self.problem = problem
            log.error("live map not open", map=self.settings.name, path=self.settings.path, reason=problem)

    def next_turn_s(self, now_s: float) -> float:
        """Return when the next turn is due."""
        if self._reading is None:
            return max(now_s, self._retry_s)
        return max(now_s, self._begun_s + LONG_S) if not self.problem else now_s + LONG_S

    def status(self) -> LiveMapRow:
        """Return the map's state, with no chunk in memory."""
        return messages.not_served(self.settings, self._budget_bytes, self.problem)


def _open_files(settings: LiveSettings) -> tuple[Folder, MapDatabase]:
    """Open a map's directory and read it; a new run of the map begins."""
    folder = Folder(settings.path)
    try:
        fixed = MapSettings(settings.resolution, settings.occupancy, settings.frame_id)
        return folder, MapDatabase(folder, fixed)
    except BaseException:
        folder.close()
        raise


def _reason(error: BaseException) -> str:
    if isinstance(error, ShmmapError):
        return error.message
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    log.error("unexpected error of a live map's files", kind=type(error).__name__, reason=str(error))
    return f"{type(error).__name__}: {error}"


class _Worker:
    """Serves the maps of the daemon's first message, each as soon as its files are read.

    A map that fails is retried.
    """

    def __init__(self, channel: socket.socket, wanted: messages.Begin) -> None:
        self._channel = channel
        self._buffer = packet_buffer()
        self._done = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._poller = select.poll()
        for readable in (channel.fileno(), self._done):
            self._poller.register(readable, select.POLLIN)
        self._wanted = wanted
        self._budget_bytes = wanted.budget_bytes // max(1, len(wanted.maps))  # of each map
        self._opening = {one.name: _OpeningMap(one, self._budget_bytes, self._wake) for one in wanted.maps}
        self._maps: dict[str, ServedMap] = {}
        self._closing = contextlib.ExitStack()  # of all maps, and of the marks
        self._ending: messages.End | None = None
        self._ending_s = self._status_s = 0.0
        self._reported: messages.Status | None = None
        self._begun = False
        self._marks: MarksDirectory | None = None

    # --- the start ------------------------------------------------------------------------------

    def _open_some(self, now_s: float) -> None:
        """Serve each map whose files are read; report once when all are served, or why they are not."""
        for name, one in list(self._opening.items()):
            found = one.run_turn(now_s)
            if found is not None:
                try:
                    self._maps[name] = self._served(one.settings, *found)
                    del self._opening[name]
                except Exception as error:  # noqa: BLE001  one map's damaged memory must not end other maps
                    one.failed(error, now_s)
        if not self._begun and all(one.problem for one in self._opening.values()):
            self._begun = True
            self._send_status(now_s)  # before READY, so that the maps' state is available by then
            chunks = sum(len(one.paged.chunks) for one in self._maps.values())
            self._send(messages.Begun(len(self._maps), chunks, *self._refusal()))

    def _refusal(self) -> tuple[str, str, str]:
        """Return why no map can be served with these settings; empty if the problem may be temporary."""
        errors = [one.error for one in self._opening.values()]
        refused = [one for one in errors if isinstance(one, ConfigError | InstanceBusy)]
        if self._maps or len(refused) < len(errors) or not refused:
            return "", "", ""
        return refused[0].code, refused[0].message, refused[0].hint

    def _served(self, settings: LiveSettings, folder: Folder, database: MapDatabase) -> ServedMap:
        """Set up a map in memory, including chunks that a previous process left there."""
        wanted = self._wanted
        prefix = live_prefix(wanted.instance, settings.name)
        limits = _limits(settings, self._budget_bytes, len(wanted.maps))
        with contextlib.ExitStack() as closing:
            closing.callback(folder.close)
            closing.callback(database.close, END_S)
            if self._marks is None:
                self._marks = MarksDirectory(wanted.marks_dir, wanted.marks_gid)
                self._closing.callback(self._marks.close)
            memory = ChunkMemory(wanted.shm_dir, prefix, wanted.gid)
            closing.callback(memory.close)
            served = ServedMap(
                settings, database, memory, limits, self._marks, self._answer, self._wake, usual_codec()
            )
            closing.callback(served.paged.close)
            adopted = served.adopt(time.monotonic())
            self._closing.push(closing.pop_all())
        log.info(
            "live map in memory",
            map=settings.name,
            path=settings.path,
            chunks=adopted,
            files=len(database.rows),
            damaged=len(database.damaged),
            lost=len(database.record.lost),
        )
        return served

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_write(self._done, 1)

    # --- turns ----------------------------------------------------------------------------------

    def run(self) -> None:
        """Serve until the daemon sends `End` or is gone."""
        while self.run_turn():
            pass
        if self._ending is not None:
            with contextlib.suppress(OSError):
                self._send(messages.Ended(self.end(self._ending)))

    def run_turn(self) -> bool:
        """Wait until work is due, and do it; return whether there is a next turn."""
        for fd, _ in self._poller.poll(self._poll_timeout_ms(time.monotonic())):
            if fd == self._done:
                os.eventfd_read(self._done)
            elif not self._receive():
                self._ending = None  # the daemon is gone: chunks stay in memory
                return False
        now_s = time.monotonic()
        ending = self._ending is not None
        if self._opening and not ending:
            self._open_some(now_s)
        for one in self._maps.values():
            one.run_turn(now_s, save_all=ending)
        if now_s >= self._status_s:
            self._send_status(now_s)
        return self._ending is None or not self._may_end(self._ending, now_s)

    def _poll_timeout_ms(self, now_s: float) -> float:
        times = [one.next_turn_s(now_s) for one in self._maps.values()]
        times += [one.next_turn_s(now_s) for one in self._opening.values() if self._ending is None]
        due_s = min(times, default=now_s + STATUS_S)
        return max(0.0, min(due_s - now_s, STATUS_S if self._ending is None else END_S)) * 1000

    def _receive(self) -> bool:
        """Handle messages from the daemon; return False when it is gone."""
        try:
            for _ in range(MESSAGES_PER_TURN):
                # answers block until the daemon reads them: the channel itself is not non-blocking
                data, _fd = receive_packet(self._channel, self._buffer, wait=False)
                if not data:
                    return False
                message = messages.decode_to_live(data)
                if isinstance(message, messages.Ask):
                    self._ask(message)
                elif isinstance(message, messages.Disconnected):
                    self._on_disconnect(message.session)
                elif isinstance(message, messages.End):
                    self._ending, self._ending_s = message, time.monotonic()
                    for one in self._maps.values():
                        one.stop_accepting()
        except BlockingIOError:
            pass
        except ConnectionResetError:
            return False
        return True

    def _ask(self, ask: messages.Ask) -> None:
        request = request_number(ask.body)
        try:
            message = decode_request(ask.body)
            if isinstance(message, LiveList):
                self._answer(ask.ticket, LiveListed(request, self._rows()))
            elif isinstance(message, LIVE_REQUESTS):
                self._map(message.map).handle(ask, message, time.monotonic())
            else:
                raise BadRequest("this is no request about live maps")
        except ShmmapError as error:
            self._answer(ask.ticket, ErrorReply(request, error.code, error.message, error.hint))
        except Exception:  # noqa: BLE001  a defect in one request must not end all others
            log.exception("request about a live map failed")
            failed = InternalError("the daemon failed on this request")
            self._answer(ask.ticket, ErrorReply(request, failed.code, failed.message, failed.hint))

    def _map(self, name: str) -> ServedMap:
        if (opening := self._opening.get(name)) is not None:
            why = opening.problem or "its files are being read"
            raise LiveInterrupted(
                f"live map {name}: {why}", hint="see `shmmap doctor`; it is tried again until that is mended"
            )
        if name not in self._maps:
            names = ", ".join(self._maps | self._opening)
            raise BadRequest(f"there is no live map {name!r}", hint=f"there are: {names}")
        return self._maps[name]

    def _on_disconnect(self, session: int) -> None:
        for one in self._maps.values():
            one.on_disconnect(session)
        if self._marks is not None:
            self._marks.on_disconnect(session)

    def _answer(self, ticket: int, reply: Any) -> None:
        self._send(messages.Reply(ticket, encode(reply)))

    def _send(self, message: messages.FromLive) -> None:
        self._channel.send(messages.encode(message))

    def _send_status(self, now_s: float) -> None:
        self._status_s = now_s + STATUS_S
        status = messages.Status(self._rows())
        if status != self._reported:
            self._reported = status
            self._send(status)

    def _rows(self) -> tuple[LiveMapRow, ...]:
        """Return the state of all maps, in the order of the settings."""
        known: dict[str, ServedMap | _OpeningMap] = {**self._opening, **self._maps}
        return tuple(known[one.name].status() for one in self._wanted.maps)

    # --- the end --------------------------------------------------------------------------------

    def _may_end(self, ending: messages.End, now_s: float) -> bool:
        """Return whether all is saved, or saving has made no progress for a while."""
        left = [one for one in self._maps.values() if not one.paged.all_durable]
        return ending.keep or all(now_s > max(one.paged.saved_s, self._ending_s) + HOPELESS_S for one in left)

    def end(self, ending: messages.End) -> tuple[messages.Unsaved, ...]:
        """Close all maps, keeping or freeing their memory; return the unsaved chunks, which stay."""
        unsaved = []
        for name, one in self._maps.items():
            if chunks := one.end(keep=ending.keep):
                unsaved.append(messages.Unsaved(name, chunks, one.paged.problem))
        self._closing.close()
        return tuple(unsaved)


def _limits(settings: LiveSettings, budget_bytes: int, maps: int) -> Limits:
    """Return the limits of one of ``maps`` maps; a quarter of its memory is reserved for chunks."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    with contextlib.suppress(OSError, ValueError):
        limit = min(limit, int(Path("/proc/sys/vm/max_map_count").read_text()))
    return Limits(
        budget_bytes,
        reserve_bytes=budget_bytes // 4,
        max_chunks=max(LEAST_CHUNKS, (limit - OTHER_DESCRIPTORS) // maps),
        most_active=settings.most_active,
        radius=settings.radius,
        hysteresis=settings.hysteresis,
        linger_s=settings.linger_s,
        checkpoint_s=settings.checkpoint_s,
    )


def main(arguments: list[str]) -> int:
    """Run with ``CHANNEL_FD PARENT_PID``; the first packet names the maps."""
    set_up_logging()
    with channel_to_parent(arguments) as channel, contextlib.suppress(ConnectionError):
        data, _ = receive_packet(channel, packet_buffer())
        if not data:
            return 0  # the daemon gave up its start
        wanted = messages.decode_to_live(data)
        if not isinstance(wanted, messages.Begin):
            return 1
        worker = _Worker(channel, wanted)
        gc.collect()
        gc.freeze()
        worker.run()
    os._exit(0)  # a thread may be blocked by a directory that hangs


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
