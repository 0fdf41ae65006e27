# SPDX-License-Identifier: Apache-2.0
"""One ROS service over CycloneDDS, in the protocol of rmw_cyclonedds_cpp.

A service has two topics, for requests and for replies; every client reads all replies and takes its own. The
server's reader and writer share an id in their user data (``serviceid=``), and so do those of a client
(``clientid=``). A reply is written only when the client's reader is known, because a reader discovered later
would miss it. The server waits up to 100 ms for it, as ``rmw_send_response`` does. At a client's first
request it waits until a second after discovery: a busy machine may discover reader and writer apart.

Other implementations of ROS send no ``clientid=``. They transport the number of a request outside of the
message, where CycloneDDS cannot read it, and their clients wait without bound: they are incompatible peers.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
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

from shmmap_clients.ros_bridge.messages import Damaged, ServiceKind
from shmmap_clients.ros_bridge.participant import endpoint_qos, reply_topic, request_topic
from shmmap_clients.ros_bridge.type_hashes import type_hash

_KNOWN_AT_FIRST_S: Final = 1.0
_KNOWN_WITHIN_S: Final = 0.1
_LOOK_EVERY_S: Final = 0.01
_KEPT: Final = 1024
"""Requests that a reader queues, of all clients together, and so more than rclcpp's ten."""
_CLIENT_ID: Final = re.compile(rb"(?:^|;)clientid=([^;]*);")
_PARTICIPANT_HEX: Final = 24
"""Number of hexadecimal digits of an endpoint's key that identify its participant."""
_VENDORS: Final = {0x0101: "RTI Connext", 0x010F: "Fast DDS", 0x0110: "CycloneDDS", 0x0112: "RustDDS"}
"""Vendors by the first two bytes of an endpoint's key, where most implementations put an id (DDSI-RTPS)."""


@dataclass(frozen=True, slots=True)
class Requester:
    """The client of a request, identified by its writer of requests.

    Attributes
    ----------
    name
        The ``clientid``, or the writer's key if there is none.
    incompatible
        Whether the client has no ``clientid``.
    vendor
        Vendor of the client's DDS; empty if unknown.
    found_s
        Time of discovery, on `time.monotonic`.
    """

    name: str
    incompatible: bool
    vendor: str
    found_s: float = 0.0


@dataclass(slots=True, eq=False)
class Request:
    """A received request, and the attempts to answer it.

    Attributes
    ----------
    server
        Server of the service.
    message
        The message; its ``client`` and ``number`` are copied to the reply.
    requester, handle
        The client, and the DDS handle of its writer.
    begun_s
        Time of the first attempt with a reachable daemon, on `time.monotonic`; 0: none yet.
    was_tried
        Whether there was an attempt, so that its client may have left since.
    is_logged
        Whether it was logged why it waits.
    """

    server: ServiceServer
    message: Any
    requester: Requester
    handle: int
    begun_s: float = 0.0
    was_tried: bool = False
    is_logged: bool = False


class ServiceServer:
    """Server of one service: takes requests and writes replies.

    Parameters
    ----------
    participant
        Participant in the domain.
    name
        Full name of the service.
    kind
        Types of the service.
    service_id
        Id of the server, unique in the domain.
    """

    def __init__(self, participant: DomainParticipant, name: str, kind: ServiceKind, service_id: str) -> None:
        self.name = name
        self.kind = kind
        belongs = f"serviceid={service_id};"
        requests = Topic(participant, request_topic(name), kind.request)
        replies = Topic(participant, reply_topic(name), kind.reply)
        self._reader = DataReader(
            participant, requests, endpoint_qos(belongs + type_hash(kind.request), depth=_KEPT)
        )
        self._writer = DataWriter(participant, replies, endpoint_qos(belongs + type_hash(kind.reply)))
        self.condition = ReadCondition(self._reader, ViewState.Any | SampleState.NotRead | InstanceState.Any)
        self._lock = threading.Lock()  # one thread takes requests, another one replies
        self._requesters: dict[int, Requester] = {}  # by DDS handle of the writer of requests
        # clientid, or else participant, by DDS handle of the reader of replies
        self._readers: dict[int, str] = {}

    def take(self) -> Iterator[Request | Damaged]:
        """Take the received requests; for an invalid message, the reason instead of a request."""
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
        """All present clients, including those without requests."""
        handles = _unsigned(self._reader.get_matched_publications())
        readers = _unsigned(self._writer.get_matched_subscriptions())
        with self._lock:
            for handle in self._requesters.keys() - handles:
                del self._requesters[handle]
            for handle in self._readers.keys() - readers:
                del self._readers[handle]
        return [found for one in handles if (found := self._requester(one)) is not None]

    def present(self, request: Request) -> bool:
        """Return whether the client can receive the reply, after a short wait for discovery of its reader.

        A client without ``clientid=`` counts as reachable after its first second, because its reader may
        belong to another participant.
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
        """Return whether the requesting client has left."""
        return self._requester(request.handle, refresh=True) is None

    def reply(self, message: Any) -> str:
        """Send a reply; return an empty text, or the reason why it cannot be sent."""
        try:
            self._writer.write(message)
        except DDSException as error:
            return str(error)
        return ""

    def _requester(self, handle: int, *, refresh: bool = False) -> Requester | None:
        """Return the client of a writer; None if it has left.  ``refresh``: look it up again."""
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
        """Look for a client's reader among the known readers."""
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
    """Return DDS handles as unsigned numbers; some calls of the package return them as signed."""
    return {one & (2**64 - 1) for one in handles}


class Listening:
    """Waits for requests of several services of a participant, on behalf of one thread.

    Parameters
    ----------
    participant
        Participant in the domain.
    log
        Called with a line about each invalid message.

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
        """Add a service."""
        self.servers.append(server)
        self._waitset.attach(server.condition)

    def wait(self, timeout_s: float) -> None:
        """Sleep until a request arrives, `wake` is called or the timeout expires."""
        self._waitset.wait(duration(nanoseconds=max(int(timeout_s * 1e9), 0)))
        self._wake.set(False)

    def wake(self) -> None:
        """End `wait`, or the next one."""
        self._wake.set(True)

    def take(self) -> Iterator[Request]:
        """Take all received requests."""
        for server in self.servers:
            for one in server.take():
                if isinstance(one, Damaged):
                    self._log(f"{server.name}: a request was no message: {one.reason}")
                else:
                    yield one
