# SPDX-License-Identifier: Apache-2.0
"""The daemon's side of the live worker: requests are passed on to it, and its answers back.

A worker that dies takes nothing with it that was answered: another one is started, which finds the chunks in
memory.  Who waited for an answer is told to ask again.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
import subprocess
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from shmmap.daemon.events.live_events import LiveEvents
from shmmap.daemon.live import messages
from shmmap.daemon.live.tickets import Tickets
from shmmap.daemon.transport.connection import Peer
from shmmap.daemon.transport.sessions import Session
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.errors import BadRequest, Busy, LiveInterrupted, ShmmapError, error_from_wire
from shmmap.logfmt import log
from shmmap.processes.start_child import packet_buffer, receive_packet, start_child
from shmmap.protocol.codec import encode
from shmmap.protocol.live import LiveList, LiveListed, LiveMapRow, LiveRequest

__all__ = ["LiveRelay", "NoLiveMaps"]

BEAT_S: Final = 0.5
BEGINNING_S: Final = 2.0
"""How long a worker that does not serve yet may take to end."""
END_S: Final = 60.0
"""How long saving everything may take at the end; the unit's stop timeout is longer."""
PAUSES_S: Final = (0.0, 0.5, 2.0, 10.0, 30.0)
"""Before another worker is started for one that ended: the first time, and later ones in a row."""
STARTS: Final = 2
"""Workers that may be killed before the maps are in memory."""
END_PATIENCE_S: Final = 0.1
"""How long the loop waits for a killed worker to end; one that hangs in the kernel may take for ever."""
HEARD_AT_ONCE: Final = 16
"""Messages of the worker that one turn of the loop takes in."""
MOST_BYTES: Final = 1 << 12
"""Of a request about live maps: names and numbers."""
MOST_UNSENT: Final = 4096
"""Messages for a worker that hears nothing just now: sessions that come and go could send without end."""
IN_ORDER_S: Final = 1.0
"""A worker that ends sooner after its maps were in memory is not started again at once a second time."""


class NoLiveMaps:
    """Where the daemon keeps none."""

    def tell(self) -> None:
        """Nothing has to be told."""

    def ask(self, session: Session, message: LiveRequest, body: bytes, now_s: float) -> None:
        """Say that there are none."""
        del body, now_s
        if isinstance(message, LiveList):
            session.connection.reply(encode(LiveListed(message.request, ())))
            return
        raise BadRequest(
            "this daemon keeps no live maps",
            hint="start it with --live NAME, or with [live.NAME] in its settings",
        )

    def left(self, session: Session) -> None:
        """Nobody has to be told."""

    def beat(self, now_s: float) -> None:
        """Nothing has to be done."""

    @property
    def next_s(self) -> float:
        """Never."""
        return math.inf

    def run_step(self, now_s: float) -> None:
        """Nothing has to be done."""

    def close(self, *, keep: bool) -> None:
        """Nothing has to be ended."""

    @property
    def unsaved(self) -> dict[str, int]:
        """Nothing can be lost."""
        return {}


class LiveRelay:
    """Has the live worker, and passes on what concerns it.

    Parameters
    ----------
    begin
        Which maps it is to keep, and where.
    watched
        Told of its descriptor.
    may_map
        Whether a process may change live maps.
    events
        Told how the maps are, twice a second, and when the worker ends and begins.

    Attributes
    ----------
    restarts : int
        Workers that ended without being asked to.
    unsaved : dict
        Chunks by map that could not be saved at the end.
    """

    def __init__(
        self,
        begin: messages.Begin,
        watched: WatchedDescriptors,
        may_map: Callable[[Peer, float], bool],
        events: LiveEvents,
    ) -> None:
        self.restarts = 0
        self.unsaved: dict[str, int] = {}
        self._begin = begin
        self._watched = watched
        self._may_map = may_map
        self._events = events
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._buffer = packet_buffer()
        self._unsent: deque[bytes] = deque()
        self._tickets = Tickets()
        self._askers: set[int] = set()
        self._serving = False
        self._failures = 0
        self._start_s = self._served_s = 0.0
        self._refused: ShmmapError | None = None
        self._rows: tuple[LiveMapRow, ...] = ()
        self._ended: messages.Ended | None = None

    # --- the worker's life ----------------------------------------------------------------------

    def start(self) -> None:
        """Start the worker; `wait_until_serving` says what came of it."""
        self._process, self._channel = start_child("shmmap.daemon.live.worker.main", new_session=True)
        self._channel.setblocking(False)
        self._serving = False
        with contextlib.suppress(ConnectionError):
            self._channel.send(messages.encode(self._begin))
        self._watched.watch(self._channel.fileno(), self.hear, "answers")

    def wait_until_serving(self, seconds: float, *, alone: bool) -> None:
        """Wait until each map is in memory or has a problem, at most so long: the rest comes by itself.

        Parameters
        ----------
        seconds
            How long points may have to wait for live maps.
        alone
            There is nothing else to serve.

        Raises
        ------
        ShmmapError
            There is nothing else, and settings or another daemon keep every map from being served.
        """
        end_s = time.monotonic() + seconds
        while not self._serving and (left_s := end_s - time.monotonic()) > 0:
            if self._channel is None:
                if self._failures > STARTS:
                    break
                self.start()
            self._wait(min(left_s, BEAT_S))
            self.hear()
            self._events.beat()
        if alone and self._refused is not None:
            raise self._refused
        if not self._serving:
            log.warning("live maps are not ready yet", maps=len(self._begin.maps), after_s=seconds)
            self._say_of_all("the process that keeps live maps is being started")

    def _say_of_all(self, problem: str) -> None:
        """Have each map shown as one that is not served just now."""
        budget_bytes = self._begin.budget_bytes // max(1, len(self._begin.maps))
        self._rows = tuple(messages.not_served(one, budget_bytes, problem) for one in self._begin.maps)
        self._events.told(self._rows)

    def tell(self) -> None:
        """Tell events from now on: clients are heard."""
        self._events.begin(len(self._begin.maps))

    def _wait(self, seconds: float) -> None:
        """Wait until the worker says something, or takes what is to be sent."""
        if self._channel is not None:
            poller = select.poll()  # `select.select` takes no descriptor above 1023
            poller.register(self._channel, select.POLLIN | (select.POLLOUT if self._unsent else 0))
            poller.poll(seconds * 1000)

    def beat(self, now_s: float) -> None:
        """Start another worker when it is time to."""
        if self._channel is None and now_s >= self._start_s:
            try:
                self.start()
            except OSError as error:
                self._start_s = now_s + PAUSES_S[-1]
                log.warning("live worker not started", reason=error.strerror)

    def hear(self) -> None:
        """Hear what the worker says, and send on what it did not take."""
        for _ in range(HEARD_AT_ONCE):
            if self._channel is None:
                return
            try:
                data, _ = receive_packet(self._channel, self._buffer)
            except BlockingIOError:
                break
            except ConnectionResetError:
                continue
            if not data:
                self._lost()
                return
            self._told(messages.decode_from_live(data))
        self._flush()

    def _told(self, message: messages.FromLive) -> None:
        if isinstance(message, messages.Answer):
            session = self._tickets.take(message.ticket)
            if session is not None:
                session.connection.reply(message.body)
        elif isinstance(message, messages.Status):
            self._rows = message.maps
            self._events.told(message.maps)
        elif isinstance(message, messages.Begun):
            self._serving, self._served_s = True, time.monotonic()
            self._refused = (
                error_from_wire(message.code, message.message, message.hint) if message.code else None
            )
            log.info("live maps ready", maps=message.maps, of=len(self._begin.maps), chunks=message.adopted)
            self._events.started(message.maps, message.adopted)
        elif isinstance(message, messages.Ended):
            self._ended = message

    def _lost(self) -> None:
        """The worker has ended: tell who waits, and start another one soon."""
        now_s = time.monotonic()
        if self._serving and now_s >= self._served_s + IN_ORDER_S:
            self._failures = 0
        self._forget()
        if self._ended is not None:
            return  # as it was asked to
        self.restarts += 1
        self._start_s = now_s + PAUSES_S[min(self._failures, len(PAUSES_S) - 1)]
        self._failures += 1
        log.error("live worker ended", restarts=self.restarts)
        self._events.ended(self.restarts)
        if self._failures > 1:  # once is hardly noticed: the next one finds what was in memory
            self._say_of_all("the process that keeps live maps ends again and again: see the log")
        self._tickets.lose()

    @property
    def next_s(self) -> float:
        """When those who wait for a worker that ended are told: at once, some at a time."""
        return 0.0 if self._tickets.are_lost else math.inf

    def run_step(self, now_s: float) -> None:
        """Tell some of them."""
        del now_s
        self._tickets.refuse_some()

    def _forget(self) -> None:
        if self._channel is not None:
            self._watched.unwatch(self._channel.fileno())
            self._channel.close()
            self._channel = None
        if self._process is not None:
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_PATIENCE_S)
            self._process = None
        self._unsent.clear()
        self._serving = False

    # --- requests -------------------------------------------------------------------------------

    def ask(self, session: Session, message: LiveRequest, body: bytes, now_s: float) -> None:
        """Pass a request on.

        Raises
        ------
        Busy
            Too many of this session's wait, or of all sessions'.
        BadRequest
            It is too long.
        LiveInterrupted
            There is no worker just now.
        """
        if len(body) > MOST_BYTES:
            raise BadRequest(f"a request about a live map has at most {MOST_BYTES} bytes")
        if isinstance(message, LiveList) and not self._serving:
            session.connection.reply(encode(LiveListed(message.request, self._rows)))
            return
        if self._channel is None or not self._serving:
            raise LiveInterrupted(
                "the process that keeps live maps is being started",
                hint="ask again: it takes long the first time",
            )
        if len(self._unsent) >= MOST_UNSENT:
            raise Busy("the process that keeps live maps hears nothing just now", hint="ask again")
        maps = self._may_map(session.peer, now_s)
        self._askers.add(session.slot)
        ticket = self._tickets.give(session, message.request)
        self._send(messages.Ask(ticket, session.slot, session.peer.uid, maps, bytes(body)))

    def left(self, session: Session) -> None:
        """A session has ended."""
        self._tickets.left(session)
        if session.slot in self._askers:
            self._askers.discard(session.slot)
            if self._channel is not None:
                self._send(messages.Left(session.slot))

    def _send(self, message: messages.ToLive) -> None:
        self._unsent.append(messages.encode(message))
        self._flush()

    def _flush(self) -> None:
        """Send what the worker takes; the rest when it has heard some."""
        if self._channel is None:
            return
        try:
            while self._unsent:
                self._channel.send(self._unsent[0])
                self._unsent.popleft()
        except BlockingIOError:
            pass
        except OSError:
            return  # it has ended: `hear` hears of it
        self._watched.watch_for(self._channel.fileno(), reading=True, writing=bool(self._unsent))

    # --- the end --------------------------------------------------------------------------------

    def close(self, *, keep: bool) -> None:
        """Have everything saved and all names taken away, or leave memory to the next run.

        What could not be saved is `unsaved` then, and stays in memory.
        """
        end_s = time.monotonic() + END_S
        ended, was_serving = None, False
        for _ in range(2):  # a worker that dies meanwhile leaves its chunks to another one
            if self._served_s and not self._serving and self._ended is None and not keep:
                self._start_to_save(end_s)
            if self._channel is None:
                break
            was_serving = self._serving
            until_s = end_s if was_serving else min(end_s, time.monotonic() + BEGINNING_S)
            ended = self._ask_to_end(until_s, keep=keep)
            if ended is not None or self._channel is not None:
                break
        if ended is not None and not keep:
            for one in ended.unsaved:
                self.unsaved[one.map] = one.chunks
                log.error(
                    "live map not saved: its chunks stay in memory for the next start", map=one.map,
                    chunks=one.chunks, reason=one.problem or "there was no time left",
                )  # fmt: skip
        elif ended is None and was_serving:
            unsaved = {row.name: row.dirty + row.saving for row in self._rows if row.dirty + row.saving}
            self.unsaved = {} if keep else unsaved
            log.error("live worker did not end in time: what is in memory stays there for the next start")
        self._forget()

    def _start_to_save(self, end_s: float) -> None:
        """Have another worker take over what one that ended has left in memory."""
        if self._channel is None:
            try:
                self.start()
            except OSError as error:
                log.error("live worker not started", reason=error.strerror)
        while self._channel is not None and not self._serving and (left_s := end_s - time.monotonic()) > 0:
            self._wait(left_s)
            self.hear()
        if not self._serving:
            log.error("live worker does not start: what is in memory stays there for the next start")

    def _ask_to_end(self, end_s: float, *, keep: bool) -> messages.Ended | None:
        """Have the worker end; what it says at last, if it does by then."""
        self._ended = None
        self._unsent.append(messages.encode(messages.End(keep)))
        while self._channel is not None and self._ended is None and (left_s := end_s - time.monotonic()) > 0:
            self._flush()
            self._wait(left_s)
            self.hear()
        return self._ended
