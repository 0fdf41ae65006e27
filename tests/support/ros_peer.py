# SPDX-License-Identifier: Apache-2.0
"""A ROS client made of the package `cyclonedds`, as rmw_cyclonedds_cpp would be one, and its map services.

``python -m tests.support.ros_peer DOMAIN`` asks once, prints how many cells came, and waits until its input
ends; it can be stopped or killed.
"""

from __future__ import annotations

import copy
import itertools
import os
import secrets
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from shmmap_clients.ros_bridge.messages import DIFFERENTIAL, PARTIAL, SELECTED, AreaInfo, ServiceKind

import shmmap
from tests.support.bridge_process import URI
from tests.support.daemon_process import DaemonProcess
from tests.support.ros.replies import Reply, from_message

WITHIN_S: Final = 60.0


def service_qos(user_data: str = "", *, latched: bool = False, depth: int = 10) -> Qos:
    """Qualities as rclcpp's for services, or of a latched topic."""
    more = [Policy.Userdata(user_data.encode())] if user_data else []
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        *more,
    )


class RosPeer:
    """A participant of a domain; use `ros_peer`."""

    def __init__(self, domain: int) -> None:
        self._number = domain
        self._domain = Domain(domain, os.environ.get("CYCLONEDDS_URI", URI))
        self.participant = DomainParticipant(domain)
        self._ids = itertools.count(1)

    def close(self) -> None:
        """Leave the domain."""
        self.participant.__del__()
        self._domain.__del__()

    @contextmanager
    def another(self) -> Iterator[RosPeer]:
        """Another participant of the same process."""
        one = copy.copy(self)
        one.participant = DomainParticipant(self._number)
        try:
            yield one
        finally:
            one.participant.__del__()

    def client(self, name: str, kind: ServiceKind, *, client_id: str | None = None) -> RosClient:
        """A client of a service; with an empty ``client_id`` one of another rmw."""
        own = f"{secrets.token_hex(6)}.{next(self._ids)}" if client_id is None else client_id
        return RosClient(self.participant, name, kind, own)

    def latched(self, name: str, kind: Any, *, within_s: float = WITHIN_S) -> Any:
        """The first message of a latched topic."""
        return next(self.following(name, kind, within_s=within_s))

    def following(
        self, name: str, kind: Any, *, latched: bool = True, within_s: float = WITHIN_S
    ) -> Iterator[Any]:
        """The messages of a topic; of a latched one from the last one on."""
        qos = service_qos(latched=latched, depth=1)
        reader = DataReader(self.participant, Topic(self.participant, f"rt{name}", kind), qos)
        return _messages(self.participant, reader, within_s)


class RosClient:
    """A client of one service."""

    def __init__(self, participant: DomainParticipant, name: str, kind: ServiceKind, client_id: str) -> None:
        self._participant = participant
        self.kind = kind
        qos = service_qos(f"clientid={client_id};" if client_id else "")
        self.writer = DataWriter(participant, Topic(participant, f"rq{name}Request", kind.request), qos)
        self.reader = DataReader(participant, Topic(participant, f"rr{name}Reply", kind.reply), qos)
        self._guid = self.writer.get_instance_handle() & (2**64 - 1)
        self._numbers = itertools.count(1)

    def close(self) -> None:
        """End the client, not its participant."""
        self.writer.__del__()
        self.reader.__del__()

    def wait_for_service(self, within_s: float = WITHIN_S) -> None:
        """Wait until the service is there."""
        until_s = time.monotonic() + within_s
        while not (self.writer.get_matched_subscriptions() and self.reader.get_matched_publications()):
            assert time.monotonic() < until_s, "the service is not there"
            time.sleep(0.002)

    def send(self, **fields: Any) -> int:
        """Send a request; returns its number."""
        number = next(self._numbers)
        self.writer.write(self.kind.request(client=self._guid, number=number, **fields))
        return number

    def receive(self, number: int, within_s: float = WITHIN_S) -> Any:
        """Wait for the reply with this number."""
        for one in _messages(self._participant, self.reader, within_s):
            if (one.client, one.number) == (self._guid, number):
                return one
        raise AssertionError("no reply")

    def call(self, within_s: float = WITHIN_S, **fields: Any) -> Any:
        """Send a request when the service is there, and wait for the reply."""
        self.wait_for_service(within_s)
        return self.receive(self.send(**fields), within_s)


def _messages(participant: DomainParticipant, reader: DataReader, within_s: float) -> Iterator[Any]:
    condition = ReadCondition(reader, ViewState.Any | SampleState.NotRead | InstanceState.Any)
    waitset = WaitSet(participant)
    waitset.attach(condition)
    until_s = time.monotonic() + within_s
    while True:
        for one in reader.take(10):
            if one.sample_info.valid_data:
                yield one
        left_s = until_s - time.monotonic()
        assert left_s > 0, "nothing came in time"
        waitset.wait(duration(milliseconds=int(left_s * 1000) + 1))


@contextmanager
def ros_peer(domain: int) -> Iterator[RosPeer]:
    """Be in a domain."""
    peer = RosPeer(domain)
    try:
        yield peer
    finally:
        peer.close()


# Autoware's three map services, asked by a peer of the package `cyclonedds`


NAMES = {
    "partial": "/map/get_partial_pointcloud_map",
    "differential": "/map/get_differential_pointcloud_map",
    "selected": "/map/get_selected_pointcloud_map",
}
KINDS = {"partial": PARTIAL, "differential": DIFFERENTIAL, "selected": SELECTED}


def asked(peer: RosPeer, verb: str, *, area: Sequence[float] = (), ids: Sequence[str] = ()) -> Reply:
    """Ask a service as a client of its own."""
    client = peer.client(NAMES[verb], KINDS[verb])
    fields: dict[str, Any] = {"area": AreaInfo(*area)} if area else {}
    if verb == "differential":
        fields["cached_ids"] = list(ids)
    elif verb == "selected":
        fields["cell_ids"] = list(ids)
    found = from_message(client.call(**fields))
    client.close()
    return found


def reload(one: DaemonProcess) -> None:
    """Have the daemon read its map again."""
    with shmmap.connect(one.endpoint) as client:
        client.reload()


# -- a ROS client as a process of its own: it asks once, says so, and waits; it can be stopped or killed


def main() -> None:
    """Ask for a few cells, then wait until the standard input ends."""
    with ros_peer(int(sys.argv[1])) as peer:
        client = peer.client(NAMES["partial"], PARTIAL)
        cells = client.call(area=AreaInfo(0.0, 0.0, 5.0)).new_pointcloud_with_ids
        print(len(cells), flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
