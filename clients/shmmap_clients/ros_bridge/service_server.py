# SPDX-License-Identifier: Apache-2.0
"""One ROS service over CycloneDDS, as rmw_cyclonedds_cpp speaks it.

A service is two topics: requests are read, replies are written, and every client reads all replies and takes
its own. Reader and writer say in their user data that they belong together (``serviceid=``), and so do a
client's (``clientid=``). A reply is written only when the client's reader is known: one that is not known yet
would miss it. Up to 100 ms are waited for that, as ``rmw_send_response`` does; the first time that a client
asks until a second after it was found, for on a busy machine its two ends may be found apart.

Other implementations of ROS send no ``clientid=``. They carry the number of a request outside of the message,
where neither can read the other's, and their clients wait without bound: they are incompatible peers.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from cyclonedds.core import (
    DDSException,
    GuardCondition,
    InstanceState,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from shmmap_clients.ros_bridge.cdr import Content
from shmmap_clients.ros_bridge.messages import Damaged, ServiceKind, ready_made
from shmmap_clients.ros_bridge.participant import endpoint_qos, reply_topic, request_topic

__all__ = ["Listening", "Request", "Requester", "ServiceServer", "Tries"]

_KNOWN_AT_FIRST_S: Final = 1.0
_KNOWN_WITHIN_S: Final = 0.1
_LOOK_EVERY_S: Final = 0.01
_KEPT: Final = 1024
"""Requests that a reader keeps until they are taken: of all clients together, so more than rclcpp's ten."""
_CLIENT_ID: Final = re.compile(rb"(?:^|;)clientid=([^;]*);")
_PARTICIPANT_HEX: Final = 24
"""Digits of an endpoint's key, in hexadecimal, that are its participant's."""
_VENDORS: Final = {0x0101: "RTI Connext", 0x010F: "Fast DDS", 0x0110: "CycloneDDS", 0x0112: "RustDDS"}
"""By the first two bytes of an endpoint's key: there most implementations put their number (DDSI-RTPS)."""


@dataclass(frozen=True, slots=True)
class Requester:
    """The client behind a request: its writer of requests.

    Attributes
    ----------
    name
        Its ``clientid``, or the key of the writer where it has none.
    incompatible
        It has none.
    vendor
        Of its DDS; empty where that is unknown.
    found_s
        When it was found, on the clock of `time.monotonic`.
    """

    name: str
    incompatible: bool
    vendor: str
    found_s: float = field(default=0.0, compare=False)


@dataclass(slots=True)
class Tries:
    """Attempts to answer a request.

    Attributes
    ----------
    begun_s
        When the first time that the daemon was there, on the clock of `time.monotonic`; 0: not yet.
    was_requeued
        It has been put back: its client may have gone.
    failed
        How often it failed although the daemon answered something else in between.
    answers
        How much the daemon had answered at the last failure.
    """

    begun_s: float = 0.0
    was_requeued: bool = False
    failed: int = 0
    answers: int = -1


@dataclass(frozen=True, slots=True)
class Request:
    """A request that has come.

    Attributes
    ----------
    server
        Of the service.
    message
        Its ``client`` and ``number`` go into the reply.
    requester, handle
        The client; DDS's number of its writer.
    tries
        Attempts so far.
    """

    server: ServiceServer
    message: Any
    requester: Requester
    handle: int
    tries: Tries = field(default_factory=Tries, compare=False)


class ServiceServer:
    """Takes requests of one service and writes replies.

    Parameters
    ----------
    participant
        Of the domain.
    name
        The service's, in full.
    kind
        Its messages.
    service_id
        Which server it is: no other of the domain has this one.
    """

    def __init__(self, participant: DomainParticipant, name: str, kind: ServiceKind, service_id: str) -> None:
        self.name = name
        self.kind = kind
        belongs = f"serviceid={service_id};"
        requests = Topic(participant, request_topic(name), kind.request)
        replies = Topic(participant, reply_topic(name), kind.reply)
        self._reader = DataReader(participant, requests, endpoint_qos(belongs, depth=_KEPT))
        self._writer = DataWriter(participant, replies, endpoint_qos(belongs))
        self.condition = ReadCondition(self._reader, ViewState.Any | SampleState.NotRead | InstanceState.Any)
        self._lock = threading.Lock()  # one thread takes requests, another one replies
        self._requesters: dict[int, Requester] = {}  # by DDS's number of the writer of requests
        # clientid, or participant where there is none, by DDS's number of the reader of replies
        self._readers: dict[int, str] = {}

    def __repr__(self) -> str:
        return f"<ServiceServer {self.name}>"

    def take(self) -> Iterator[Request | Damaged]:
        """Take the requests that have come; of one that is no message of the service, why not."""
        for one in self._reader.take(_KEPT):
            if not one.sample_info.valid_data:
                continue
            if isinstance(one, Damaged):
                yield one
                continue
            (handle,) = _unsigned([one.sample_info.publication_handle])
            requester = self._requester(handle)
            if requester is not None:
                yield Request(self, one, requester, handle)

    def requesters(self) -> list[Requester]:
        """All clients that there are now, whether they have asked or not."""
        handles = _unsigned(self._reader.get_matched_publications())
        readers = _unsigned(self._writer.get_matched_subscriptions())
        with self._lock:
            for handle in self._requesters.keys() - handles:
                del self._requesters[handle]
            for handle in self._readers.keys() - readers:
                del self._readers[handle]
        return [found for one in handles if (found := self._requester(one)) is not None]

    def present(self, request: Request) -> bool:
        """Whether the client can receive the reply; waits a moment for its reader to be found.

        A client without ``clientid=`` counts as present after its first second: its reader may belong to
        another participant.
        """
        requester = request.requester
        owner = requester.name[:_PARTICIPANT_HEX] if requester.incompatible else requester.name
        with self._lock:
            if owner in self._readers.values():
                return True
        until_s = requester.found_s + _KNOWN_AT_FIRST_S
        if not requester.incompatible:
            until_s = max(time.monotonic() + _KNOWN_WITHIN_S, until_s)
        while not self._has_reader(owner):
            if self.gone(request):
                return False
            if time.monotonic() >= until_s:
                return requester.incompatible
            time.sleep(_LOOK_EVERY_S)
        return True

    def gone(self, request: Request) -> bool:
        """Whether the requesting client is gone."""
        return self._requester(request.handle, refresh=True) is None

    def reply(self, content: Content) -> str:
        """Send a reply; returns why it cannot be sent, empty when it was."""
        return self._write(ready_made(self.kind.reply, content))

    def reply_fields(self, request: Request, **fields: Any) -> str:
        """Send a reply of these fields; returns why it cannot be sent, empty when it was."""
        message = request.message
        return self._write(self.kind.reply(client=message.client, number=message.number, **fields))

    def _write(self, message: Any) -> str:
        try:
            self._writer.write(message)
        except DDSException as error:
            return str(error)
        return ""

    def _requester(self, handle: int, *, refresh: bool = False) -> Requester | None:
        """Return the client behind a writer; None when it is gone.  ``refresh``: look it up again."""
        with self._lock:
            known = self._requesters.get(handle)
            if known is not None and (
                not refresh or handle in _unsigned(self._reader.get_matched_publications())
            ):
                return known
            found = None if known is not None else self._reader.get_matched_publication_data(handle)
            if found is None:
                self._requesters.pop(handle, None)
                return None
            client_id = _client_id(found)
            vendor = _VENDORS.get(int.from_bytes(found.key.bytes[:2], "big"), "")
            one = Requester(client_id or found.key.hex, not client_id, vendor, time.monotonic())
            self._requesters[handle] = one
            return one

    def _has_reader(self, owner: str) -> bool:
        """Look for a client's reader among those that are known now."""
        handles = _unsigned(self._writer.get_matched_subscriptions())
        with self._lock:
            for handle in handles - self._readers.keys():
                found = self._writer.get_matched_subscription_data(handle)
                if found is not None:
                    self._readers[handle] = _client_id(found) or found.key.hex[:_PARTICIPANT_HEX]
            return owner in self._readers.values()


def _client_id(endpoint: Any) -> str:
    data = endpoint.qos[Policy.Userdata]
    found = _CLIENT_ID.search(data.data) if data is not None else None
    return found[1].decode("ascii", "backslashreplace") if found else ""


def _unsigned(handles: Iterable[int]) -> set[int]:
    """Numbers of DDS as they are: some of the package's calls take them for signed ones."""
    return {one & (2**64 - 1) for one in handles}


class Listening:
    """Some services of a participant, whose requests one thread takes: it sleeps until one has come.

    Parameters
    ----------
    participant
        Of the domain.
    log
        Takes a line about what came and was no request.

    Attributes
    ----------
    servers
        The services.
    """

    def __init__(self, participant: DomainParticipant, log: Callable[[str], None]) -> None:
        self.servers: list[ServiceServer] = []
        self._log = log
        self._waitset = WaitSet(participant)
        self._wake = GuardCondition(participant)
        self._waitset.attach(self._wake)

    def add(self, server: ServiceServer) -> None:
        """Listen to one service more."""
        self.servers.append(server)
        self._waitset.attach(server.condition)

    def wait(self, timeout_s: float) -> None:
        """Sleep until a request has come, `wake` is called or the timeout is over."""
        self._waitset.wait(duration(nanoseconds=max(int(timeout_s * 1e9), 0)))

    def wake(self) -> None:
        """End `wait`, and every later one at once."""
        self._wake.set(True)

    def take(self) -> Iterator[Request]:
        """Take all requests that have come."""
        for server in self.servers:
            for one in server.take():
                if isinstance(one, Damaged):
                    self._log(f"{server.name}: a request was no message: {one.reason}")
                else:
                    yield one
