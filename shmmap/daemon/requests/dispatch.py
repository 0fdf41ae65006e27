# SPDX-License-Identifier: Apache-2.0
"""Dispatch of requests: each is decoded, authorised and routed to its handler, or refused."""

from __future__ import annotations

import math
import sys
import time
import traceback
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

from shmmap.daemon.cache.holders import Survey, Usage
from shmmap.daemon.live_relay import LiveRelay, NoLiveMaps
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.handshake import Handshake
from shmmap.daemon.requests.limits import check_intent
from shmmap.daemon.requests.map_queries import MapQueries
from shmmap.daemon.requests.operators.operator_requests import (
    OPERATOR_REQUESTS,
    Authorization,
    OperatorRequests,
)
from shmmap.daemon.telemetry.sampler import Sampler
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.inbox import WorkItem
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import BadRequest, InternalError, NoSession, ShmmapError
from shmmap.logfmt import log
from shmmap.protocol import messages
from shmmap.protocol.codec import decode_request, encode, request_number, unpack_versions
from shmmap.protocol.live import LIVE_REQUESTS
from shmmap.statistics.writer import StatisticsWriter

RELEASED_PER_STEP: Final = 16
"""Versions released between two looks at the time."""
MAX_DEFECTS: Final = 100
WITHIN_S: Final = 10.0
"""`MAX_DEFECTS` exceptions from one line of code within this time are fatal; one of them is logged."""


class Defects:
    """Unexpected exceptions while serving: counted and survived, unless one line of code keeps raising.

    Parameters
    ----------
    clock
        Seconds.
    """

    def __init__(self, statistics: StatisticsWriter, clock: Callable[[], float] = time.monotonic) -> None:
        self._statistics = statistics
        self._now_s = clock
        self._met: defaultdict[tuple[str, int], deque[float]] = defaultdict(
            partial(deque, maxlen=MAX_DEFECTS)
        )
        self._logged_s: dict[tuple[str, int], float] = {}

    def record(self) -> bool:
        """Record the exception being handled; return True when its line has raised too often to continue.

        The traceback is logged, unless one of the same line was logged within `WITHIN_S`.
        """
        self._statistics.add("defects")
        *_, (frame, line) = traceback.walk_tb(sys.exc_info()[2])
        place, now_s = (frame.f_code.co_filename, line), self._now_s()
        if now_s >= self._logged_s.get(place, -math.inf) + WITHIN_S:
            self._logged_s[place] = now_s
            log.exception("defect", place=f"{place[0]}:{place[1]}", hint="please report it")
        met = self._met[place]
        met.append(now_s)
        return len(met) == MAX_DEFECTS and now_s - met[0] <= WITHIN_S


@dataclass(eq=False, slots=True)
class Dispatch:
    """Hands each request to its handler; a defect in one request does not affect the others.

    Parameters
    ----------
    due
        Queues the steps that answer a request, to run in the turns of the connection's process.
    """

    handshake: Handshake
    cells: CellRequests
    queries: MapQueries
    operators: OperatorRequests
    authorization: Authorization
    live: LiveRelay | NoLiveMaps
    survey: Survey
    sampler: Sampler
    defects: Defects
    due: Callable[[Connection, Iterator[None]], None]

    def handle(self, item: WorkItem) -> Iterator[None]:
        """Answer or refuse one request, in several steps where that takes long."""
        data = item.body
        request = 0
        try:
            if item.is_multipart:
                raise BadRequest("a request is one frame")
            message = decode_request(data)
            request = message.request
            work = self._route(item.connection, message, data)
            if work is not None:
                yield from work
        except ShmmapError as error:
            item.connection.refuse(request or request_number(data), error)
        except Exception:  # noqa: BLE001  a defect met by one request must not end the others'
            self.defects.record()
            item.connection.refuse(request, InternalError("the daemon failed on this request"))

    def _route(self, connection: Connection, message: messages.Request, body: bytes) -> Iterator[None] | None:
        """Handle a request; return the steps that remain if it takes several."""
        now_s = time.monotonic()
        if isinstance(message, messages.Hello):
            entered = self.handshake.enter(connection, message, now_s)
            connection.reply(encode(self.queries.welcome(entered, message)))
            return None
        session = self.handshake.sessions.slots.get(connection.slot)
        if session is None:
            raise NoSession("this daemon does not know the session", hint="send hello first")
        session.requests += 1
        session.last_request_s = now_s
        if isinstance(message, messages.Differential | messages.Area | messages.Selected):
            if message.intent is not None:
                check_intent(message.intent)
                session.state_intent(message.intent)
            self.cells.serve(session, message)
            return None
        if isinstance(message, messages.Release):
            return self._release(session, message)
        if isinstance(message, OPERATOR_REQUESTS):
            self.authorization.require(connection.peer, now_s)
            return self.operators.handle(session, message, now_s)
        if isinstance(message, LIVE_REQUESTS):
            self.live.ask(session, message, body, now_s)
        elif isinstance(message, messages.Metadata):
            self.queries.metadata(session, message, now_s)
        elif isinstance(message, messages.Cancel):
            self.cells.cancel(session, message.request)
        elif isinstance(message, messages.Bye):
            self.handshake.leave(session)
        elif isinstance(message, messages.Stats):
            self.handshake.look_after_departed()
            self.survey.ask(
                session, lambda usage: self.due(connection, self._answer_stats(session, message, usage))
            )
        else:
            connection.reply(encode(self.queries.answer(message)))
        return None

    def _release(self, session: Session, message: messages.Release) -> Iterator[None]:
        versions = list(session.held) if message.packed is None else unpack_versions(message.packed)
        for begin in range(0, len(versions), RELEASED_PER_STEP):
            yield
            self.cells.release(session.drop(versions[begin : begin + RELEASED_PER_STEP]))
        session.connection.reply(encode(messages.Released(message.request)))

    def _answer_stats(self, session: Session, message: messages.Stats, usage: Usage) -> Iterator[None]:
        self.sampler.measure()
        reply = yield from self.queries.stats(message, usage)
        session.connection.reply(encode(reply))
