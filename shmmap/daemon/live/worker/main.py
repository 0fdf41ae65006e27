# SPDX-License-Identifier: Apache-2.0
"""The live worker's process: it hears the daemon, and gives each map its turns.

It dies with the daemon, and whenever it dies the next one finds what was applied in shared memory.
"""

from __future__ import annotations

import contextlib
import gc
import mmap
import os
import resource
import select
import signal
import socket
import stat
import sys
import time
from pathlib import Path
from typing import Any, Final

from shmmap.chunks.applying import UNDO_BYTES, UndoRecord
from shmmap.chunks.chunk_file import usual_codec
from shmmap.daemon.config_live import LiveSettings
from shmmap.daemon.host.logs import set_up_logging
from shmmap.daemon.live import messages
from shmmap.daemon.live.adopting import adopt
from shmmap.daemon.live.chunk_memory import ChunkMemory, live_prefix
from shmmap.daemon.live.folder import Folder
from shmmap.daemon.live.live_map import LiveMap
from shmmap.daemon.live.map_files import MapFiles
from shmmap.daemon.live.paging.records import Limits
from shmmap.daemon.live.worker.applied_scans import APPLIED_BYTES, AppliedScans
from shmmap.daemon.live.worker.marks_directory import MarksDirectory
from shmmap.daemon.live.worker.opening import OpeningMap
from shmmap.daemon.live.worker.served_map import ServedMap
from shmmap.daemon.live.worker.voxel_lists import VoxelLists
from shmmap.errors import (
    BadRequest,
    CannotStart,
    ConfigError,
    InstanceBusy,
    InternalError,
    LiveInterrupted,
    ShmmapError,
)
from shmmap.logfmt import log
from shmmap.processes.end_with_parent import die_with
from shmmap.processes.start_child import packet_buffer, receive_packet
from shmmap.protocol.codec import decode_request, encode, request_number
from shmmap.protocol.live import LIVE_REQUESTS, LiveList, LiveListed, LiveMapRow
from shmmap.protocol.messages import ErrorReply

__all__ = ["main"]

STATUS_S: Final = 0.5
HEARD_AT_ONCE: Final = 16
END_S: Final = 0.2
HOPELESS_S: Final = 10.0
"""At the end, after so long without a file that could be written, what is left is not saved."""
OTHERS: Final = 512
"""Descriptors and mappings that are no chunks'."""
LEAST_CHUNKS: Final = 64


class _Worker:
    """Serves the maps that the daemon names first, each when its files have been read."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._buffer = packet_buffer()
        self._done = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._wanted: messages.Begin | None = None
        self._opening: dict[str, OpeningMap] = {}
        self._maps: dict[str, ServedMap] = {}
        self._closing: dict[str, contextlib.ExitStack] = {}
        self._ending: messages.End | None = None
        self._ending_s = self._status_s = 0.0
        self._reported: messages.Status | None = None
        self._begun = False
        self._marks: MarksDirectory | None = None

    # --- the start ------------------------------------------------------------------------------

    def begin(self, wanted: messages.Begin) -> None:
        """Begin to bring the maps into memory; what hinders one is its problem, and tried again."""
        self._wanted = wanted
        for one in wanted.maps:
            self._opening[one.name] = OpeningMap(one, self._budget_bytes(wanted), self._wake)

    @staticmethod
    def _budget_bytes(wanted: messages.Begin) -> int:
        return wanted.budget_bytes // max(1, len(wanted.maps))

    def _open_some(self, now_s: float) -> None:
        """Serve each map whose files have been read; say that all are, or why not, the first time."""
        for name, one in list(self._opening.items()):
            found = one.turn(now_s)
            if found is not None:
                try:
                    self._maps[name] = self._served(one.settings, *found)
                    del self._opening[name]
                except Exception as error:  # noqa: BLE001  what is in one map's memory ends no other map
                    one.failed(error, now_s)
        if not self._begun and all(one.problem for one in self._opening.values()):
            self._begun = True
            self._tell(now_s)  # before READY is said: then the maps' state can be read
            self._send(messages.Begun(len(self._maps), self._chunks, *self._refusal()))

    @property
    def _chunks(self) -> int:
        return sum(len(one.live.chunks) for one in self._maps.values())

    def _refusal(self) -> tuple[str, str, str]:
        """Why no map can be served until a person has changed something; empty where that may pass."""
        errors = [one.error for one in self._opening.values()]
        refused = [one for one in errors if isinstance(one, ConfigError | InstanceBusy)]
        if self._maps or len(refused) < len(errors) or not refused:
            return "", "", ""
        return refused[0].code, refused[0].message, refused[0].hint

    def _served(self, settings: LiveSettings, folder: Folder, files: MapFiles) -> ServedMap:
        """Bring a map into memory: what an earlier process left there, and room for more."""
        wanted = self._wanted
        assert wanted is not None  # noqa: S101
        mode = 0o640 if wanted.gid >= 0 else 0o600
        prefix = live_prefix(wanted.instance, settings.name)
        with contextlib.ExitStack() as closing:
            closing.callback(folder.close)
            if self._marks is None:
                self._marks = MarksDirectory(wanted.marks_dir, wanted.marks_gid)
            memory = ChunkMemory(wanted.shm_dir, prefix, mode=mode, gid=wanted.gid)
            closing.callback(memory.close)
            closing.callback(_forget_records, wanted.shm_dir + prefix, memory)
            live = LiveMap(
                files, memory, UndoRecord(_record(wanted.shm_dir + prefix + "undo", UNDO_BYTES)),
                _limits(settings, self._budget_bytes(wanted), len(wanted.maps)), usual_codec(),
                on_work_done=self._wake,
            )  # fmt: skip
            closing.callback(live.close)
            lists = VoxelLists(live, wanted.shm_dir, mode, wanted.gid)
            lists.remove_all()
            adopted = adopt(live, time.monotonic())
            applied = AppliedScans(_record(wanted.shm_dir + prefix + "applied", APPLIED_BYTES))
            served = ServedMap(settings, live, lists, self._marks, applied, self._answer)
            self._closing[settings.name] = closing.pop_all()
        log.info(
            "live map in memory", map=settings.name, path=settings.path, chunks=adopted,
            files=len(live.files.rows), damaged=len(live.files.damaged), missing=len(live.files.missing),
        )  # fmt: skip
        return served

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_write(self._done, 1)

    # --- turns ----------------------------------------------------------------------------------

    def run(self) -> None:
        """Serve until the daemon says that it ends, or is gone."""
        poller = select.poll()
        poller.register(self._channel, select.POLLIN)
        poller.register(self._done, select.POLLIN)
        while True:
            now_s = time.monotonic()
            for fd, _ in poller.poll(self._patience_ms(now_s)):
                if fd == self._done:
                    os.eventfd_read(self._done)
                elif not self._hear():
                    return  # the daemon is gone: what is in memory stays there
            now_s = time.monotonic()
            ending = self._ending is not None
            if self._opening and not ending:
                self._open_some(now_s)
            for one in self._maps.values():
                one.turn(now_s, save_all=ending)
            if now_s >= self._status_s:
                self._tell(now_s)
            if self._ending is not None and self._may_end(self._ending, now_s):
                break
        with contextlib.suppress(OSError):
            self._send(messages.Ended(self.end(self._ending)))

    def _patience_ms(self, now_s: float) -> float:
        times = [one.next_turn_s(now_s) for one in self._maps.values()]
        times += [one.next_turn_s(now_s) for one in self._opening.values() if self._ending is None]
        due_s = min(times, default=now_s + STATUS_S)
        return max(0.0, min(due_s - now_s, STATUS_S if self._ending is None else END_S)) * 1000

    def _hear(self) -> bool:
        """Hear what the daemon says; False when it is gone."""
        try:
            for _ in range(HEARD_AT_ONCE):
                # answers wait until the daemon takes them: the channel itself is not made non-blocking
                data, _fd = receive_packet(self._channel, self._buffer, wait=False)
                if not data:
                    return False
                message = messages.decode_to_live(data)
                if isinstance(message, messages.Ask):
                    self._ask(message)
                elif isinstance(message, messages.Left):
                    self._left(message.session)
                elif isinstance(message, messages.End):
                    self._ending, self._ending_s = message, time.monotonic()
                    for one in self._maps.values():
                        one.stop_taking()
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
        except Exception:  # noqa: BLE001  a defect met by one request must not end everybody's
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

    def _left(self, session: int) -> None:
        for one in self._maps.values():
            one.left(session)
        if self._marks is not None:
            self._marks.forget(session)

    def _answer(self, ticket: int, reply: Any) -> None:
        self._send(messages.Answer(ticket, encode(reply)))

    def _send(self, message: messages.FromLive) -> None:
        self._channel.send(messages.encode(message))

    def _tell(self, now_s: float) -> None:
        self._status_s = now_s + STATUS_S
        status = messages.Status(self._rows())
        if status != self._reported:
            self._reported = status
            self._send(status)

    def _rows(self) -> tuple[LiveMapRow, ...]:
        """How all maps are, in the order in which they were named."""
        wanted = self._wanted.maps if self._wanted is not None else ()
        known: dict[str, ServedMap | OpeningMap] = {**self._opening, **self._maps}
        return tuple(known[one.name].status() for one in wanted)

    # --- the end --------------------------------------------------------------------------------

    def _may_end(self, ending: messages.End, now_s: float) -> bool:
        """Whether all is saved, or nothing more can be: no file of what is left was written for a while."""
        left = [one for one in self._maps.values() if not one.is_saved]
        return ending.keep or all(now_s > max(one.live.saved_s, self._ending_s) + HOPELESS_S for one in left)

    def end(self, ending: messages.End) -> tuple[messages.Unsaved, ...]:
        """Leave memory as it is, or empty; returns what stays there because it is nowhere else."""
        unsaved = []
        for name, one in self._maps.items():
            if chunks := one.end(keep=ending.keep):
                unsaved.append(messages.Unsaved(name, chunks, one.live.problem))
        if self._marks is not None:
            self._marks.close()
        for closing in self._closing.values():
            closing.close()
        return tuple(unsaved)


def _limits(settings: LiveSettings, budget_bytes: int, maps: int) -> Limits:
    """What one of this many maps may take; what is beside its chunks leaves them a quarter of the memory."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    with contextlib.suppress(OSError, ValueError):
        limit = min(limit, int(Path("/proc/sys/vm/max_map_count").read_text()))
    return Limits(
        budget_bytes, reserve_bytes=budget_bytes // 4,
        most_chunks=max(LEAST_CHUNKS, (limit - OTHERS) // maps), most_active=settings.most_active,
        radius=settings.radius, hysteresis=settings.hysteresis, linger_s=settings.linger_s,
        checkpoint_s=settings.checkpoint_s,
    )  # fmt: skip


def _forget_records(prefix: str, memory: ChunkMemory) -> None:
    """Remove what is kept of chunks in memory where there is none any more."""
    if not list(memory.names()):
        for name in ("undo", "applied"):
            with contextlib.suppress(FileNotFoundError):
                os.unlink(prefix + name)


def _record(path: str, nbytes: int) -> mmap.mmap:
    """A file in shared memory that outlives this process, made of zeros if there is none."""
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    fd = os.open(path, flags, 0o600)
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
            raise CannotStart(
                f"{path} is not a file of this user, but of user {status.st_uid}",
                hint="remove it, or choose another name for the instance",
            )
        os.posix_fallocate(fd, 0, nbytes)
        return mmap.mmap(fd, nbytes)
    finally:
        os.close(fd)


def main(arguments: list[str]) -> int:
    """Run with ``CHANNEL_FD PARENT_PID``; the first packet says which maps."""
    die_with(int(arguments[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the daemon's to handle
    set_up_logging()
    with socket.socket(fileno=int(arguments[0])) as channel, contextlib.suppress(ConnectionError):
        data, _ = receive_packet(channel, packet_buffer())
        if not data:
            return 0  # the daemon did not start after all
        wanted = messages.decode_to_live(data)
        if not isinstance(wanted, messages.Begin):
            return 1
        worker = _Worker(channel)
        worker.begin(wanted)
        gc.collect()
        gc.freeze()
        worker.run()
    os._exit(0)  # a thread may wait for a directory that hangs


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
