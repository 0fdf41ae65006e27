# SPDX-License-Identifier: Apache-2.0
"""Publishing worker: a process that makes the layers of one cell after the other and sends their objects.

Layers are made as in `shmmap.prepare` and in loaders.  While one cell is sent, the next one is made.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Final

import msgspec

from shmmap.errors import InternalError, MapDataError, ShmmapError
from shmmap.layers.build import make_layer
from shmmap.layers.contract import Box
from shmmap.layers.disk_cache import LayerCache
from shmmap.layers.points import LAYER
from shmmap.layers.sources import FILES, CellJob, CellSource, Files, SourceReader
from shmmap.layers.spec import LayerSpec, layer_spec
from shmmap.origin.remote.published_index import MILLIMETRES
from shmmap.origin.remote.published_object import (
    MAX_OBJECT_BYTES,
    ObjectName,
    bare_object,
    pack_object,
    read_bare_header,
    to_millimetres,
)
from shmmap.origin.remote.store import Store
from shmmap.prepare.task_pool import CellTask, Ready, decode_task, encode
from shmmap.prepare.worker import CellPoints
from shmmap.processes.request_threads import leave
from shmmap.processes.start_child import MAX_PACKET_BYTES, channel_to_parent
from shmmap.publishing.messages import (
    TASKS_AHEAD,
    CellSent,
    KnownObjects,
    LayerSent,
    NotSent,
    PublishSettings,
)
from shmmap.publishing.new_version import send_object
from shmmap.quantities import format_bytes
from shmmap.segment.layout import SegmentHeader, SourceStamp
from shmmap.segment.version import Source

_NICENESS: Final = 5
_XYZ: Final = "xyz"


class RoundedFiles(Files):
    """Reader of files that gives points rounded and ordered, as readers of the published map see them."""

    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        """Read the file, with its points rounded and in their published order."""
        found = super().read(source, box, None if needs is None else [_XYZ, *(n for n in needs if n != _XYZ)])
        table = found.points
        columns = {name: values for name, values in table.columns.items() if needs is None or name in needs}
        rounded = to_millimetres(table.columns[_XYZ])
        if rounded is None:
            return replace(found, points=replace(table, columns=columns))
        xyz = rounded.xyz
        ordered = {name: xyz if name == _XYZ else values[rounded.order] for name, values in columns.items()}
        low, high = float(xyz[:, 2].min()), float(xyz[:, 2].max())
        return replace(found, points=replace(table, columns=ordered), z_min=low, z_max=high)


@dataclass(frozen=True, slots=True)
class _Layer:
    """A layer's object; ``frame`` is None if the version before already has the object."""

    name: ObjectName
    frame: bytes | None


@dataclass(frozen=True, slots=True)
class MadeCell:
    """Objects of a cell's layers; ``points`` is the header of layer ``points``, None if it was not made."""

    points: SegmentHeader | None
    layers: tuple[_Layer, ...]


class LayerRefused(Exception):
    """Error for a layer that cannot be made, with the reason."""

    def __init__(self, layer: str, code: str, message: str, hint: str = "") -> None:
        super().__init__(message)
        self.layer, self.code, self.message, self.hint = layer, code, message, hint


class CellMaker:
    """Makes the objects of cells, in one thread.

    Parameters
    ----------
    known
        Objects that need not be made again.
    cache, keep
        Cache that may already have layers, and whether to keep new ones in it.
    millimetres
        Round points to millimetres.
    reader
        Reads the cells' points; None: from files.
    """

    def __init__(
        self,
        known: KnownObjects,
        cache: LayerCache | None,
        *,
        keep: bool = False,
        millimetres: bool = False,
        reader: SourceReader | None = None,
    ) -> None:
        self._known = known
        self._millimetres = millimetres
        self._cache = cache if not millimetres else None  # the cache's layers are made of exact points
        self._keep = keep
        self._reader = reader or (RoundedFiles() if millimetres else FILES)

    def make(self, task: CellTask) -> MadeCell:
        """Make the objects of a cell's layers; raise `LayerRefused` if a layer cannot be made."""
        specs = [layer_spec(name) for name in task.layers]
        source = CellPoints(task.source, task.box, specs, self._reader)
        layers, headers = [], []
        for spec, around in zip(specs, task.around, strict=True):
            job = CellJob(task.cell_id, task.source, task.box, task.frame_id, around, self._reader)
            header, layer = self._layer(spec, job, source)
            headers.append(header)
            layers.append(layer)
        states: set[SourceStamp] = {header.source for header in headers}
        if len(states) > 1:
            raise LayerRefused(
                str(specs[0]), MapDataError.code, f"{task.source.name}: the file changed while it was read"
            )
        points = headers[task.layers.index(LAYER)] if LAYER in task.layers else None
        return MadeCell(points, tuple(layers))

    def _layer(self, spec: LayerSpec, job: CellJob, source: CellPoints) -> tuple[SegmentHeader, _Layer]:
        name = str(spec)
        try:
            fd = os.memfd_create("layer", os.MFD_CLOEXEC)
            try:
                made = make_layer(
                    spec, job, fd, cache=self._cache, keep=self._keep, source=lambda: source.points(spec)
                )
                header = made.header
                if header.total_bytes > MAX_OBJECT_BYTES:
                    raise MapDataError(
                        f"{name} has {format_bytes(header.total_bytes)}, more than the"
                        f" {format_bytes(MAX_OBJECT_BYTES)} that a published layer of a cell may have",
                        path=job.source.name,
                        cause="too_large",
                        hint="divide the map into smaller cells",
                    )
                rounded = self._millimetres and name == LAYER
                unpacked = bare_object(_contents(fd, header.total_bytes), millimetres=rounded)
                if rounded:
                    bare = read_bare_header(unpacked, name)
                    header = msgspec.structs.replace(header, z_min=bare.z_min, z_max=bare.z_max)
                return header, self._object(unpacked)
            finally:
                os.close(fd)
        except ShmmapError as error:
            raise LayerRefused(name, error.code, error.message, error.hint) from None
        except OSError as error:
            message = f"{error.filename or job.source.name}: {error.strerror or error}"
            raise LayerRefused(name, MapDataError.code, message) from None
        except MemoryError:
            message = f"{job.source.name}: building {name} ran out of memory"
            raise LayerRefused(name, MapDataError.code, message) from None
        except Exception as error:  # noqa: BLE001  a builder of another package may raise anything
            message = f"{job.source.name}: building {name} failed: {error!r}"
            raise LayerRefused(name, InternalError.code, message) from None

    def _object(self, unpacked: bytearray) -> _Layer:
        content = sha256(unpacked).digest()
        found = self._known.find(content)
        if found is not None:
            return _Layer(found, None)
        return _Layer(*pack_object(unpacked, content))


def _contents(fd: int, nbytes: int) -> memoryview:
    data = bytearray(nbytes)
    view = memoryview(data)
    at = 0
    while at < nbytes:
        got = os.preadv(fd, [view[at:]], at)
        if not got:
            raise MapDataError("a layer ended early")
        at += got
    return view


class Sender:
    """Sends objects to the store; thread-safe."""

    def __init__(self, store: Store, send: Callable[[CellSent | NotSent], None], *, is_first: bool) -> None:
        self._store = store
        self._send = send
        self._is_first = is_first
        self._there: set[bytes] = set()

    def send(self, number: int, cell: MadeCell) -> None:
        """Send the objects of a cell that the store does not have, and report the cell."""
        try:
            layers = tuple(
                LayerSent(*layer.name, self._sent(layer.name, layer.frame)) for layer in cell.layers
            )
            header = cell.points
            described = (header.rows, header.z_min, header.z_max) if header is not None else (0, 0.0, 0.0)
            outside = header.outside_points if header is not None else 0
            self._send(CellSent(number, *described, layers, outside))
        except ShmmapError as error:
            self._send(NotSent(number, "", error.code, error.message, error.hint))
        except Exception as error:  # noqa: BLE001  reported, and then ends the run
            self._send(NotSent(number, "", InternalError.code, repr(error), ""))

    def refuse(self, why: NotSent) -> None:
        """Report that a cell was not sent."""
        self._send(why)

    def _sent(self, name: ObjectName, frame: bytes | None) -> int:
        if frame is None:
            return 0
        if name.sha256 in self._there:
            return 0
        is_new = send_object(self._store, name.path, frame, look=not self._is_first)
        self._there.add(name.sha256)
        return name.size if is_new else 0


def _work(channel: socket.socket, argument: str) -> None:
    settings = msgspec.json.decode(argument, type=PublishSettings)
    store = settings.open_store()
    cache = LayerCache(settings.cache_dir, limit_bytes=1 << 62) if settings.cache_dir else None
    maker = CellMaker(KnownObjects(settings.known), cache, millimetres=settings.encoding == MILLIMETRES)

    def send(message: CellSent | NotSent) -> None:
        channel.send(encode(message))

    sender = Sender(store, send, is_first=settings.is_first)
    channel.send(encode(Ready()))
    packets = iter(lambda: channel.recv(MAX_PACKET_BYTES), b"")
    make_and_send(map(decode_task, packets), maker, sender)


def make_and_send(
    tasks: Iterable[CellTask], maker: CellMaker, sender: Sender, *, ending: Collection[str] = ()
) -> None:
    """Make cells, and send them in other threads, until there are no more tasks.

    Parameters
    ----------
    ending
        Codes of errors that end the run, because every other cell would fail with them, too.
    """
    with ThreadPoolExecutor(TASKS_AHEAD, "send") as pool:

        def work_on(task: CellTask) -> None:
            try:
                cell = maker.make(task)
            except LayerRefused as error:
                layer = "" if error.code in ending else error.layer
                sender.refuse(NotSent(task.number, layer, error.code, error.message[:2000], error.hint))
            else:
                pool.submit(sender.send, task.number, cell)

        for task in tasks:
            work_on(task)


def run_worker(arguments: list[str], work: Callable[[socket.socket, str], None]) -> int:
    """Run ``work`` with the channel and settings given by ``CHANNEL_FD PARENT_PID SETTINGS``."""
    channel = channel_to_parent(arguments)
    os.nice(_NICENESS)
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        work(channel, arguments[2])
    return 0


def main(arguments: list[str]) -> int:
    """Run with ``CHANNEL_FD PARENT_PID SETTINGS``, the settings as JSON."""
    return run_worker(arguments, _work)


if __name__ == "__main__":
    leave(main(sys.argv[1:]))
