# SPDX-License-Identifier: Apache-2.0
"""The serving loop: one thread, one ROUTER socket, nothing in it that waits for a disk.

Requests come first; between them the loop hears its workers, watches its clients' processes and
frees memory.  Files are read and layers built elsewhere (`workers`).
"""

from __future__ import annotations

import logging
import math
import select
import time
from collections.abc import Callable
from typing import Final

import zmq

from shmmap.daemon.cache.cell_cache import Store
from shmmap.daemon.cache.ledger import Resident
from shmmap.daemon.cache.survey import Usage
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.events.map_events import tell_reload, tell_reload_failed
from shmmap.daemon.map.catalogue_reload import Reloader
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.handshake import Reception
from shmmap.daemon.requests.limits import bounded_intent
from shmmap.daemon.requests.map_queries import MapQueries
from shmmap.daemon.requests.operators.authorization import Privileges
from shmmap.daemon.requests.operators.operator_pins import OperatorPins
from shmmap.daemon.requests.operators.operator_requests import OPERATOR_REQUESTS, OperatorRequests
from shmmap.daemon.telemetry.sampler import BEAT_S, Sampler
from shmmap.daemon.transport.crowd_control import CrowdControl
from shmmap.daemon.transport.inbox import Heard, Hearing, peer_of
from shmmap.daemon.transport.listen_gate import ListenGate
from shmmap.daemon.transport.outbox import Replies
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.errors import BadRequest, Busy, InternalError, NoSession, ShmmapError
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol import messages
from shmmap.protocol.codec import decode_request, encode, request_number, unpack_versions
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Server"]

_log = logging.getLogger(__name__)

SERVE_S: Final = 0.002
"""How long requests are served before the loop looks at everything else."""
FAREWELL_S: Final = 1.0
"""How long a stop waits for the one who asked for it: libzmq drops a reply that was not read when the
connection ends (ZMQ_IMMEDIATE)."""
WORTH_AN_ANSWER_BYTES: Final = 1 << 16
"""A longer request that is refused unread is dropped: finding its number takes too long."""


class Server:
    """Serves one map until told to stop.

    Parameters
    ----------
    socket
        Bound ROUTER socket; closed by the caller.
    queries
        Everything that is no request for cells and no operator's.
    pins
        The cells that operators pinned.
    on_beat
        Called a few times a second, from the loop itself: whoever is hung does not beat.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        store: Store,
        sessions: Sessions,
        statistics: StatisticsWriter,
        queries: MapQueries,
        pins: OperatorPins,
        reloader: Reloader,
        privileges: Privileges,
        event_log: EventLog,
        *,
        epoch: int,
        quota_bytes: int,
        on_beat: Callable[[], None],
    ) -> None:
        self._socket = socket
        self._store = store
        self._sessions = sessions
        self._statistics = statistics
        self._queries = queries
        self._operators = OperatorRequests(
            store, pins, reloader, send=self._send, refuse=self._refuse, stop_for=self._stop_for
        )
        self._privileges = privileges
        self._event_log = event_log
        self._epoll = select.epoll()
        self._events: dict[int, Callable[[], None]] = {}
        self._stopping = False
        self._asked_to_stop: Session | None = None
        self._stop_by_s = math.inf
        self._answer_at_end = True
        self.cells = CellRequests(
            store, statistics, epoch=epoch, quota_bytes=quota_bytes, send=self._send, clock=time.monotonic
        )
        self._reception = Reception(
            sessions,
            self.cells,
            statistics,
            event_log,
            watch=self.watch,
            unwatch=self.unwatch,
            on_left=self._left,
        )
        self._sampler = Sampler(
            store, statistics, event_log, sessions=sessions, waiting=self.cells, on_beat=on_beat
        )
        self.watch(reloader.fd, lambda: reloader.collect(self._change_map, self._keep_map))
        self._replies = Replies(socket, statistics)
        self._hearing = Hearing(socket, sessions, statistics, self._refuse_unread)
        self._survey = store.survey
        self._gate = ListenGate(self.watch, self.unwatch)
        self._crowd = CrowdControl(
            self._gate,
            waiting_bytes=self._hearing.waiting_bytes,
            unread_bytes=lambda: self._replies.unread(list(sessions)),
            session_descriptors=lambda: [session.fd for session in sessions],
        )
        for fd, hear in ((store.reclaimer.pins.fd, store.loads.hear), (store.names.fd, store.hear_of_names)):
            if fd >= 0:
                self.watch(fd, lambda hear=hear: hear(time.monotonic()))  # type: ignore[misc]
        self._poller = zmq.Poller()
        self._poller.register(socket, zmq.POLLIN)
        self._poller.register(self._epoll.fileno(), zmq.POLLIN)

    # --- other sources of events ------------------------------------------------------------------

    def watch(self, fd: int, callback: Callable[[], None]) -> None:
        """Call ``callback`` from the loop whenever ``fd`` is readable."""
        self._events[fd] = callback
        self._epoll.register(fd, select.EPOLLIN)

    def unwatch(self, fd: int) -> None:
        """Stop watching; before the descriptor is closed."""
        if self._events.pop(fd, None) is not None:
            self._epoll.unregister(fd)

    def watch_worker(self, fd: int) -> None:
        """Hear a loader worker."""
        self.watch(fd, lambda: self._on_worker(fd))

    def _on_worker(self, fd: int) -> None:
        worker = self._store.loads.pool.by_fd(fd)
        if worker is not None:
            self._store.loads.on_worker(worker, time.monotonic())

    @property
    def stopping(self) -> bool:
        """Whether the loop ends after this turn."""
        return self._stopping

    def guard(self) -> None:
        """From now on descriptors and memory are watched; call it when everything is bound."""
        self._gate.close_behind()
        self._replies.paths = self._gate.paths
        self._crowd.begin()

    def watch_crowd(self, now_s: float) -> None:
        """Look whether clients take more than there is; called a few times a second."""
        self._crowd.beat(now_s)

    def stop(self, *, answer: bool = True) -> None:
        """Leave the loop after this turn; without ``answer`` those who wait are left to the next life."""
        self._stopping = True
        self._answer_at_end = answer

    # --- the loop ---------------------------------------------------------------------------------

    def run(self) -> None:
        """Serve until `stop`; then answer those who still wait."""
        while not self._stopping:
            now_s = time.monotonic()
            until_s = min(
                self._store.loads.next_event_s(),
                self.cells.next_deadline_s(),
                self._sampler.next_s,
                self._survey.next_step_s,
            )
            timeout_ms = max(0, -int(-(until_s - now_s) * 1000 // 1))
            busy = len(self._hearing) or not self._crowd.idle
            ready = self._poller.poll(0 if busy else min(timeout_ms, int(BEAT_S * 1000)))
            self._turn(ready)
        self._gate.release()
        if self._answer_at_end:
            self.cells.answer_all(time.monotonic())
            while not self._survey.idle:
                self._survey.step()

    def close(self) -> None:
        """Stop watching; after everything watched is gone."""
        self._epoll.close()

    def _turn(self, ready: list[tuple[object, int]]) -> None:
        for source, _events in ready:
            if source is not self._socket:
                for fd, _mask in self._epoll.poll(0):
                    callback = self._events.get(fd)
                    if callback is not None:
                        callback()
        self._serve()
        now_s = time.monotonic()
        self._survey.turn(now_s)
        self._crowd.step()
        self._store.loads.end_overdue(now_s)
        self._store.loads.pump(now_s)
        self.cells.answer_overdue(now_s)
        self._sampler.turn(now_s)
        if now_s >= self._stop_by_s:
            self.stop()

    # --- requests -----------------------------------------------------------------------------------

    def _serve(self) -> None:
        """Hear everybody, serve those whose turn it is; for a bounded time."""
        start_s = time.monotonic()
        end_s = start_s + SERVE_S
        more = True
        while start_s < end_s:
            more = more and self._hearing.hear()
            heard = self._hearing.take()
            if heard is None:
                if not more:
                    return
                continue
            self._handle(heard)
            now_s = time.monotonic()
            self._hearing.served(heard, now_s - start_s)
            self._statistics.add_duration("request", int((now_s - start_s) * 1e9))
            start_s, more = now_s, True

    def _handle(self, heard: Heard) -> None:
        """Answer one request, or say why not."""
        data = heard.frame.buffer
        request = 0
        try:
            if heard.several_frames:
                raise BadRequest("a request is one frame")
            message = decode_request(data)
            request = message.request
            self._dispatch(heard.identity, heard.frame, message)
        except ShmmapError as error:
            self._refuse(heard.identity, request or request_number(data), error)
        except Exception:  # noqa: BLE001  a defect met by one request must not end everybody's
            _log.exception("a request could not be handled; this is a defect in shmmap")
            self._refuse(heard.identity, request, InternalError("the daemon failed on this request"))

    def _refuse_unread(self, heard: Heard) -> None:
        """A process has too many requests waiting to have this one served, ever."""
        data = heard.frame.buffer
        if len(data) <= WORTH_AN_ANSWER_BYTES:
            error = Busy("too many requests of this process wait to be served", hint="wait for the replies")
            self._refuse(heard.identity, request_number(data), error)

    def _dispatch(self, identity: bytes, frame: zmq.Frame, message: messages.Request) -> None:
        now_s = time.monotonic()
        if isinstance(message, messages.Hello):
            entered = self._reception.enter(identity, frame, message, now_s)
            self._send(entered, encode(self._queries.welcome(entered, message)))
            return
        session = self._sessions.get(identity)
        if session is None:
            raise NoSession("this daemon does not know the session", hint="send hello first")
        session.requests += 1
        session.last_request_s = now_s
        if isinstance(message, messages.Differential | messages.Area | messages.Selected):
            if message.intent is not None:
                session.intent, session.says_where = bounded_intent(message.intent), True
            if isinstance(message, messages.Differential):
                self.cells.differential(session, message, now_s)
            elif isinstance(message, messages.Area):
                self.cells.area(session, message, now_s)
            else:
                self.cells.selected(session, message, now_s)
        elif isinstance(message, messages.Release):
            self.cells.let_go(self._released(session, message))
            self._send(session, encode(messages.Released(message.request)))
        elif isinstance(message, messages.Bye):
            self._reception.leave(session)
        elif isinstance(message, OPERATOR_REQUESTS):
            self._privileges.require(peer_of(frame), now_s)
            self._operators.handle(session, message, now_s)
        elif isinstance(message, messages.Stats):
            self._survey.ask(session, lambda usage: self._tell_stats(session, message, usage))
        else:
            self._send(session, encode(self._queries.answer(message)))

    def _stop_for(self, session: Session) -> None:
        self._asked_to_stop, self._stop_by_s = session, time.monotonic() + FAREWELL_S

    def _tell_stats(self, session: Session, message: messages.Stats, usage: Usage) -> None:
        self._sampler.measure()
        self._send(session, encode(self._queries.stats(message, usage, time.monotonic())))

    def _released(self, session: Session, message: messages.Release) -> list[Resident]:
        if message.packed is None:
            return session.drop(list(session.held))
        return session.drop(unpack_versions(message.packed))

    def _left(self, session: Session) -> None:
        if session is self._asked_to_stop:
            self.stop()

    # --- reload -------------------------------------------------------------------------------------

    def _change_map(self, catalogue: Catalogue) -> None:
        old, now_s = self._store.catalogue, time.monotonic()
        self.cells.renumber(lambda index: catalogue.find(old.id(index)), old.id)
        change = self._store.replace_catalogue(catalogue, now_s)
        tell_reload(self._event_log, self._statistics, catalogue, change, self._store.wire_id)
        _log.info(
            "map read again: %d cells changed, %d added, %d removed",
            len(change.changed), len(change.added), len(change.removed),
        )  # fmt: skip
        for problem in catalogue.problems:
            _log.warning("%s", problem)

    def _keep_map(self, error: ShmmapError) -> None:
        tell_reload_failed(self._event_log, self._statistics, self._store.catalogue.map_version, error)

    # --- replies --------------------------------------------------------------------------------------

    def _send(self, session: Session, reply: bytes) -> None:
        self._replies.send(session, reply)

    def _refuse(self, identity: bytes, request: int, error: ShmmapError) -> None:
        self._replies.refuse(identity, request, error)
