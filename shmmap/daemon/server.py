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
from itertools import chain
from typing import Final

import zmq

from shmmap.daemon.admin import Admin
from shmmap.daemon.cells import CellRequests
from shmmap.daemon.heartbeat import BEAT_S, Heartbeat
from shmmap.daemon.privileges import Privileges
from shmmap.daemon.reloading import Reloader
from shmmap.daemon.residency import Resident
from shmmap.daemon.sessions import Peer, Session, Sessions
from shmmap.daemon.store import Store
from shmmap.errors import BadRequest, InternalError, NoSession, ProtocolMismatch, ShmmapError
from shmmap.origin.catalogue import Catalogue, compare
from shmmap.protocol import messages
from shmmap.protocol.codec import decode_request, encode, request_number, unpack_versions
from shmmap.segment.crash_steps import step
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Server"]

_log = logging.getLogger(__name__)

REQUESTS_AT_ONCE: Final = 64
_PRIVILEGED: Final = (
    messages.Reload,
    messages.Evict,
    messages.Pin,
    messages.Unpin,
    messages.Shutdown,
)


class Server:
    """Serves one map until told to stop.

    Parameters
    ----------
    socket
        Bound ROUTER socket; closed by the caller.
    admin
        Everything that is not a request for cells.
    on_beat
        Called a few times a second, from the loop itself: whoever is hung does not beat.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        store: Store,
        sessions: Sessions,
        statistics: StatisticsWriter,
        admin: Admin,
        reloader: Reloader,
        privileges: Privileges,
        *,
        epoch: int,
        quota_bytes: int,
        on_beat: Callable[[], None],
    ) -> None:
        self._socket = socket
        self._store = store
        self._sessions = sessions
        self._statistics = statistics
        self._admin = admin
        self._reloader = reloader
        self._privileges = privileges
        self._epoll = select.epoll()
        self._events: dict[int, Callable[[], None]] = {}
        self._stopping = False
        self._answer_at_end = True
        self.cells = CellRequests(
            store, statistics, epoch=epoch, quota_bytes=quota_bytes, send=self._send, clock=time.monotonic
        )
        self._heartbeat = Heartbeat(store, statistics, sessions=sessions, waiting=self.cells, on_beat=on_beat)
        self.watch(reloader.fd, lambda: reloader.collect(self._change_map))
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
                self._store.loads.next_event_s(), self.cells.next_deadline_s(), self._heartbeat.next_s
            )
            timeout_ms = max(0, -int(-(until_s - now_s) * 1000 // 1))
            ready = self._poller.poll(min(timeout_ms, int(BEAT_S * 1000)))
            self._turn(ready)
        if self._answer_at_end:
            self.cells.answer_all(time.monotonic())

    def close(self) -> None:
        """Stop watching; after everything watched is gone."""
        self._epoll.close()

    def _turn(self, ready: list[tuple[object, int]]) -> None:
        for source, _events in ready:
            if source is self._socket:
                for _ in range(REQUESTS_AT_ONCE):
                    if not self._receive():
                        break
            else:
                for fd, _mask in self._epoll.poll(0):
                    callback = self._events.get(fd)
                    if callback is not None:
                        callback()
        now_s = time.monotonic()
        self._store.loads.end_overdue(now_s)
        self._store.loads.pump(now_s)
        self.cells.answer_overdue(now_s)
        self._heartbeat.turn(now_s)

    # --- requests -----------------------------------------------------------------------------------

    def _receive(self) -> bool:
        """Take one request from the socket; False when there is none."""
        try:
            identity = self._socket.recv(zmq.NOBLOCK)
        except zmq.Again:
            return False
        frame = self._socket.recv(copy=False)
        extra = frame.more
        while extra:  # no request has more than one frame: read and drop what is left of it
            extra = self._socket.recv(copy=False).more
        data = frame.buffer
        self._statistics.add("requests")
        self._statistics.add("bytes_received", len(data))
        request = 0
        try:
            if frame.more:
                raise BadRequest("a request is one frame")
            message = decode_request(data)
            request = message.request
            self._dispatch(identity, frame, message)
        except ShmmapError as error:
            self._refuse(identity, request or request_number(data), error)
        except Exception:  # noqa: BLE001  a defect met by one request must not end everybody's
            _log.exception("a request could not be handled; this is a defect in shmmap")
            self._refuse(identity, request, InternalError("the daemon failed on this request"))
        return True

    def _dispatch(self, identity: bytes, frame: zmq.Frame, message: messages.Request) -> None:
        now_s = time.monotonic()
        session = self._sessions.get(identity)
        if isinstance(message, messages.Hello):
            self._hello(identity, frame, message, session, now_s)
            return
        if session is None:
            raise NoSession("this daemon does not know the session", hint="send hello first")
        session.requests += 1
        session.last_request_s = now_s
        if isinstance(message, messages.Differential | messages.Area | messages.Selected):
            if message.intent is not None:
                _check_intent(message.intent)
                session.intent, session.says_where = message.intent, True
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
            self.end_session(session)
        else:
            if isinstance(message, _PRIVILEGED):
                self._privileges.require(_peer(frame), now_s)
            if isinstance(message, messages.Shutdown):
                _log.info("stopping at the request of pid %d, uid %d", session.peer.pid, session.peer.uid)
                self._send(session, encode(messages.Stopping(message.request)))
                self.stop()
            elif isinstance(message, messages.Reload):
                self._reload_for(session, message)
            else:
                if isinstance(message, messages.Stats):
                    self._heartbeat.measure()
                self._send(session, encode(self._admin.answer(message, now_s)))

    def _hello(
        self, identity: bytes, frame: zmq.Frame, message: messages.Hello, old: Session | None, now_s: float
    ) -> None:
        if message.major != messages.PROTOCOL_VERSION[0]:
            raise ProtocolMismatch(
                f"client speaks protocol {message.major}.{message.minor},"
                f" daemon {messages.PROTOCOL_VERSION[0]}.{messages.PROTOCOL_VERSION[1]}",
                hint="update the older of the two",
            )
        peer = _peer(frame)
        if old is not None and old.peer == peer:
            session = old  # a repeated hello: its answer was late or lost
        else:
            if old is not None:
                self.end_session(old)
            idle = self._sessions.idlest_unwatched() if self._sessions.full else None
            if idle is not None:
                self.end_session(idle)
            if self._sessions.full:
                raise BadRequest(f"there are {Sessions.LIMIT} sessions already")
            session = self._sessions.open(identity, peer, message.client, now_s)
            self._statistics.add("sessions_opened")
            if session.pidfd >= 0:
                self.watch(session.pidfd, lambda: self.end_session(session))
        self._send(session, encode(self._admin.welcome(session, message)))

    def _released(self, session: Session, message: messages.Release) -> list[Resident]:
        if message.packed is None:
            return session.drop(list(session.held))
        return session.drop(unpack_versions(message.packed))

    def end_session(self, session: Session) -> None:
        """A client's process ended, or it said goodbye: what it held may be free now."""
        held = session.residents()
        self.cells.forget(session)
        if session.pidfd >= 0:
            self.unwatch(session.pidfd)
        self._sessions.close(session)
        self.cells.let_go(held)

    # --- reload -------------------------------------------------------------------------------------

    def _reload_for(self, session: Session, message: messages.Reload) -> None:
        before = self._store.catalogue

        def answer(result: Catalogue | ShmmapError) -> None:
            if isinstance(result, ShmmapError):
                self._refuse(session.identity, message.request, result)
                return
            change = compare(before, result)
            reloaded = messages.Reloaded(
                message.request,
                result.map_version,
                len(change.changed),
                len(change.added),
                len(change.removed),
                result.problems,
            )
            self._send(session, encode(reloaded))

        self._reloader.ask(answer)

    def reload(self, answer: Callable[[Catalogue | ShmmapError], None]) -> None:
        """Read the map's catalogue again (SIGHUP), and say what came of it."""
        self._reloader.ask(answer)

    def _change_map(self, catalogue: Catalogue) -> None:
        old, now_s = self._store.catalogue, time.monotonic()
        self.cells.renumber(lambda index: catalogue.find(old.id(index)), old.id)
        change = self._store.replace_catalogue(catalogue, now_s)
        self._statistics.add("reloads")
        _log.info(
            "map read again: %d cells changed, %d added, %d removed",
            len(change.changed), len(change.added), len(change.removed),
        )  # fmt: skip
        for problem in catalogue.problems:
            _log.warning("%s", problem)

    # --- replies --------------------------------------------------------------------------------------

    def _send(self, session: Session, reply: bytes) -> None:
        self._send_to(session.identity, reply)

    def _send_to(self, identity: bytes, reply: bytes) -> None:
        step("daemon.reply")
        try:
            self._socket.send(identity, zmq.SNDMORE | zmq.NOBLOCK)
            self._socket.send(reply, zmq.NOBLOCK)
            step("daemon.replied")
        except zmq.ZMQError as error:
            _log.warning("a reply was dropped: %s", error)
            return
        self._statistics.add("replies")
        self._statistics.add("bytes_sent", len(reply))

    def _refuse(self, identity: bytes, request: int, error: ShmmapError) -> None:
        self._statistics.add("errors_returned")
        self._send_to(identity, encode(messages.ErrorReply(request, error.code, error.message, error.hint)))


def _check_intent(intent: messages.Intent) -> None:
    """Refuse what has no order by distance: one NaN would mix up everybody's evictions and loads."""
    numbers = (intent.x, intent.y, intent.vx, intent.vy, intent.heading or 0.0, *chain(*intent.route))
    if not all(map(math.isfinite, numbers)):
        raise BadRequest("intent: every number in it must be finite")


def _peer(frame: zmq.Frame) -> Peer:
    try:
        address = frame.get("Peer-Address")
    except zmq.ZMQError:
        return Peer()
    return Peer.parse(str(address))
