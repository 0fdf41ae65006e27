# SPDX-License-Identifier: Apache-2.0
"""`RosBridge`: the node ``pointcloud_map_loader`` of a ROS 2 system, which serves the daemon's map.

Four threads: one answers with cells, one with voxels if there is a live map, one with parameters, and one
follows the daemon's events.  The first three take their own requests; the third also updates the list of
present clients every second.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import Final

import msgspec
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from shmmap import Client
from shmmap.live import LiveMap
from shmmap_clients.closed_at_end import ClosedAtEnd
from shmmap_clients.ros_bridge.live_worker import LIVE_SERVICES, LiveWorker
from shmmap_clients.ros_bridge.map_worker import MapWorker
from shmmap_clients.ros_bridge.messages import (
    DIFFERENTIAL,
    PARTIAL,
    SELECTED,
    MapMetaData,
    PointCloud2,
    ServiceKind,
)
from shmmap_clients.ros_bridge.parameters import PARAMETER_SERVICES, Parameters
from shmmap_clients.ros_bridge.participant import (
    close,
    endpoint_qos,
    node_name,
    open_participant,
    resolved,
    topic,
)
from shmmap_clients.ros_bridge.service_server import Listening, Requester, ServiceServer
from shmmap_clients.ros_bridge.status_file import StatusFile
from shmmap_clients.ros_bridge.type_hashes import type_hash
from shmmap_clients.ros_bridge.worker import Worker
from shmmap_clients.ros_cells import MAX_BYTES, follow_events

NAMES: Final[Mapping[str, str]] = {
    "partial": "get_partial_pointcloud_map",
    "differential": "get_differential_pointcloud_map",
    "selected": "get_selected_pointcloud_map",
    "metadata": "pointcloud_map_metadata",
    "whole": "pointcloud_map",
    "live": "/shmmap/live",
}
"""Default names of services and topics in the node's namespace; `BridgeSettings.names` overrides them."""
_KINDS: Final = {"partial": PARTIAL, "differential": DIFFERENTIAL, "selected": SELECTED}
_LOOK_S: Final = 1.0
_ADVICE: Final = "use shmmap-ros-node, or start it with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp"
_MAX_LISTED: Final = 32


class BridgeSettings(msgspec.Struct, frozen=True):
    """Settings of the bridge in ROS.

    Attributes
    ----------
    domain
        DDS domain, ``ROS_DOMAIN_ID``.
    node, namespace
        Name of the node, and namespace of names that do not begin with a slash.
    names
        Names that override those of `NAMES`.
    wait_s
        Time for cells to load, seconds.
    plain_ids
        Whether cells have ids without versions, as from Autoware's map loader.
    whole_map, whole_bytes
        Whether to publish the whole map, and its largest size.
    voxels_every_s
        Shortest time between publications of voxels, seconds.
    """

    domain: int = 0
    node: str = "pointcloud_map_loader"
    namespace: str = "/map"
    names: Mapping[str, str] = {}
    wait_s: float = 30.0
    plain_ids: bool = False
    whole_map: bool = False
    whole_bytes: int = MAX_BYTES
    voxels_every_s: float = 1.0

    def name(self, what: str) -> str:
        """Return the full name of a service or topic."""
        return resolved(self.names.get(what, NAMES[what]), self.namespace)


class RosBridge(ClosedAtEnd):
    """Serves the daemon's map to ROS nodes.

    Parameters
    ----------
    client
        Client of the daemon, used only by the bridge.
    settings
        Settings in ROS.
    log
        Called with a line about each problem.
    live
        Live map to serve as well, on a different client.

    Raises
    ------
    BadRequest
        A name or the domain is invalid in ROS, or the whole map is too large.
    Busy
        Another bridge of this daemon runs in this domain.
    CannotStart
        CycloneDDS cannot start.
    DaemonUnreachable
        The daemon does not answer.
    """

    def __init__(
        self,
        client: Client,
        settings: BridgeSettings,
        log: Callable[[str], None],
        live: LiveMap | None = None,
    ) -> None:
        self._settings = settings
        self._endpoint = client.endpoint
        self._log = log
        self._stop = threading.Event()
        self._ended: SimpleQueue[None] = SimpleQueue()  # an event's lock may be held where a signal arrives
        self._ids = 0
        self._id = secrets.token_bytes(12)
        self._incompatible = _IncompatiblePeers(log)
        with contextlib.ExitStack() as undo:
            own = resolved(node_name(settings.node), settings.namespace)
            services = {one: settings.name(one) for one in NAMES}
            welcome = client.welcome
            self._status = StatusFile(client.endpoint, welcome.instance, settings.domain)
            undo.callback(self._status.close)
            domain, self._participant = open_participant(settings.domain)
            undo.callback(close, self._participant, domain)
            self._map = MapWorker(
                client,
                self._latched(services["metadata"], MapMetaData),
                self._latched(services["whole"], PointCloud2) if settings.whole_map else None,
                Listening(self._participant, log),
                wait_s=settings.wait_s,
                whole_bytes=settings.whole_bytes,
                plain_ids=settings.plain_ids,
                stop=self._stop,
                log=log,
            )
            self._workers: list[Worker] = [self._map]
            self._map.begin()
            for what, kind in _KINDS.items():
                self._add(services[what], kind, self._map.listening)
            if live is not None:
                self._add_live(live, services["live"])
            self._parameters = Parameters(
                {
                    "enable_whole_load": settings.whole_map,
                    "enable_downsampled_whole_load": False,
                    "enable_partial_load": True,
                    "enable_selected_load": True,
                    "pcd_metadata_path": "",
                    "pcd_paths_or_directory": [welcome.map_path],
                    "use_sim_time": False,
                },
                {"pcd_paths_or_directory": "the map that shmmap serves"},
            )
            self._listening = Listening(self._participant, log)
            for name, kind in PARAMETER_SERVICES.items():
                self._add(f"{own}/{name}", kind, self._listening)
            self._write_status()
            self._undo = undo.pop_all()

    def stop(self) -> None:
        """End `run`; may be called from a signal handler."""
        self._ended.put(None)

    def run(self) -> None:
        """Serve until `stop` is called."""
        with ThreadPoolExecutor(2 + len(self._workers)) as threads:
            runs: list[Future[None]] = [
                threads.submit(self._answer_parameters),
                threads.submit(follow_events, self._endpoint, self._stop, self._map.notify),
                *(threads.submit(one.run) for one in self._workers),
            ]
            for one in runs:
                one.add_done_callback(lambda _: self.stop())
            try:
                self._ended.get()
            finally:
                self._stop.set()
                for listening in self._all_listening:
                    listening.wake()
        for one in runs:
            one.result()

    def close(self) -> None:
        """Leave the domain."""
        self._undo.close()

    # --- what is served -----------------------------------------------------------------------------

    @property
    def _all_listening(self) -> list[Listening]:
        return [self._listening, *(worker.listening for worker in self._workers)]

    def _add(self, name: str, kind: ServiceKind, listening: Listening) -> None:
        self._ids += 1
        number = self._id + self._ids.to_bytes(4, "big")
        service_id = ".".join(f"{one:x}" for one in number)  # in the notation of rmw_cyclonedds_cpp
        listening.add(ServiceServer(self._participant, name, kind, service_id))

    def _latched(self, name: str, kind: type) -> DataWriter:
        qos = endpoint_qos(type_hash(kind), depth=1, latched=True)
        return DataWriter(self._participant, Topic(self._participant, topic(name), kind), qos)

    def _add_live(self, live: LiveMap, place: str) -> None:
        qos = endpoint_qos(type_hash(PointCloud2), depth=1)
        clouds = {
            kind: DataWriter(
                self._participant,
                Topic(self._participant, topic(f"{place}/{kind}_voxels"), PointCloud2),
                qos,
            )
            for kind in ("occupied", "free")
        }
        worker = LiveWorker(
            live,
            clouds,
            Listening(self._participant, self._log),
            every_s=self._settings.voxels_every_s,
            stop=self._stop,
            log=self._log,
        )
        self._workers.append(worker)
        for name, kind in LIVE_SERVICES.items():
            self._add(f"{place}/{name}", kind, worker.listening)

    # --- requests -----------------------------------------------------------------------------------

    def _answer_parameters(self) -> None:
        look_s = 0.0
        while not self._stop.is_set():
            self._listening.wait(_LOOK_S)
            for request in self._listening.take():
                server = request.server
                asked = request.message
                fields = self._parameters.reply(server.name.rpartition("/")[2], asked)
                reply = server.kind.reply(client=asked.client, number=asked.number, **fields)
                if server.present(request) and (why := server.reply(reply)):
                    self._log(f"{server.name}: an answer was not sent: {why}")
            if time.monotonic() >= look_s:
                self._look()
                look_s = time.monotonic() + _LOOK_S

    def _look(self) -> None:
        """Update the list of present clients."""
        servers = [server for one in self._all_listening for server in one.servers]
        clients = [(server, one) for server in servers for one in server.requesters()]
        self._incompatible.look(clients)
        self._write_status(len({one.name for _, one in clients}))

    def _write_status(self, clients: int = 0) -> None:
        self._status.write(
            {
                "domain": self._settings.domain,
                "node": resolved(self._settings.node, self._settings.namespace),
                "clients": clients,
                "incompatible": self._incompatible.now,
            }
        )


class _IncompatiblePeers:
    """Clients that wait without bound, because their ROS does not use CycloneDDS.

    Parameters
    ----------
    log
        Called once with a line about each client.

    Attributes
    ----------
    now
        Present incompatible clients, at most 32: ``service``, and ``vendor`` of their DDS or empty.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._logged: dict[str, None] = {}
        self.now: list[dict[str, str]] = []

    def look(self, clients: Iterable[tuple[ServiceServer, Requester]]) -> None:
        """Record the present clients, and log each new incompatible one."""
        found = [(server, one) for server, one in clients if one.incompatible]
        for server, one in found:
            if one.name in self._logged:
                continue
            self._logged[one.name] = None
            vendor = f", speaks {one.vendor}" if one.vendor else ""
            self._log(
                f"a client of {server.name} is no node of rmw_cyclonedds_cpp{vendor}: unbounded wait;"
                f" {_ADVICE}"
            )
        while len(self._logged) > 8 * _MAX_LISTED:
            del self._logged[next(iter(self._logged))]
        self.now = [{"service": server.name, "vendor": one.vendor} for server, one in found[:_MAX_LISTED]]
