# SPDX-License-Identifier: Apache-2.0
"""Publishes a map: sends its new objects, then makes all of it the current version atomically.

If a run is killed at any moment, the version that was current stays complete.  A second run does not send the
objects again that the first one has sent.
"""

from __future__ import annotations

import itertools
import os
import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np

from shmmap.errors import BadRequest, MapDataError, MapMissing
from shmmap.failpoints import step
from shmmap.layers.points import LAYER
from shmmap.layers.spec import canonical_layers, layer_spec
from shmmap.layers.versions import LayerVersions
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.remote.map_versions import Entry, new_entry, read_root, read_shards
from shmmap.origin.remote.published_index import (
    EXACT,
    MAX_ROOT_BYTES,
    LayerObjects,
    Root,
    Shard,
    is_id_prefix,
    map_version_of,
    pack_root,
    pack_shard,
)
from shmmap.origin.remote.store import Store, refuse_read_only
from shmmap.prepare.run import Failure, task_of
from shmmap.prepare.task_pool import CellTask
from shmmap.processes.request_threads import RequestThreads
from shmmap.progress import Progress
from shmmap.publishing.messages import CellSent, NotSent, PublishSettings, write_known_objects
from shmmap.publishing.new_version import (
    begin_version,
    refuse_if_late,
    run_workers,
    send_packed,
    switch_version,
)
from shmmap.publishing.shards import CellObjects, check_cells, divide_into_shards, shard_side
from shmmap.quantities import counted

if TYPE_CHECKING:
    from shmmap.publishing.signing import MapSigner

_SHARDS_PER_BATCH: Final = 16


@dataclass(slots=True)
class Published:
    """Result of publishing.

    Attributes
    ----------
    version
        Number of the new version; None if nothing has changed or a layer could not be made.
    current
        Number of the version that is current now; 0 if there is none.
    root
        SHA-256 of the root's object.
    objects, sent_objects, sent_bytes
        Number of objects of the version's layers; number and bytes of all objects that were sent.
    bytes
        Bytes of the objects of all layers.
    outside
        Number of points outside of their cell's box, by the ids of such cells.
    """

    cells: int
    layers: tuple[str, ...]
    id_prefix: str = ""
    encoding: str = EXACT
    version: int | None = None
    current: int = 0
    map_version: int = 0
    root: str = ""
    objects: int = 0
    sent_objects: int = 0
    sent_bytes: int = 0
    bytes: int = 0
    failures: list[Failure] = field(default_factory=list)
    outside: dict[str, int] = field(default_factory=dict)

    @property
    def notes(self) -> list[str]:
        """Remarks on the map, a sentence each."""
        if not self.outside:
            return []
        name = max(self.outside, key=lambda one: self.outside[one])
        cells = f"{counted(len(self.outside), 'cell')} of {self.cells:,}"
        missing = "where areas are asked for, these points can be missing"
        return [f"points outside of their cell's box in {cells}: {self.outside[name]:,} in {name}; {missing}"]


class _ShardRow(NamedTuple):
    """The root's row for a shard."""

    key: tuple[int, int]
    cells: int
    size: int
    sha256: bytes


def publish_map(
    catalogue: Catalogue,
    store: Store,
    layers: Sequence[str],
    *,
    settings: PublishSettings,
    id_prefix: str = "",
    resend: bool = False,
    signer: MapSigner | None = None,
    workers: int,
    progress: Progress,
) -> Published:
    """Publish a map, and make it current.

    Parameters
    ----------
    store, settings
        The store, and the settings by which workers open it; `publish_map` fills in the known objects.
    layers
        Specs of layers besides ``points``, in any form.
    id_prefix
        Prefix of all ids; empty: that of the version before, or ``/<last part of the URL>/`` for the first.
    resend
        Send every object again, as if the store had none, and make this a new version.
    signer
        Signs the version; required for a signed map.
    workers
        Number of processes that make layers.

    Returns
    -------
    The result.  If it has failures, no version was made current.

    Raises
    ------
    BadRequest
        A layer is unknown, the prefix differs from that of earlier versions, or the store is read-only.
    Offline, CannotWrite, MapDataError
        The store does not answer or refuses; its current version is damaged; or the run took longer than a
        day.
    InstanceBusy
        Another publisher was quicker: its version is current.
    """
    refuse_read_only(store)
    check_cells(catalogue)
    names = (LAYER, *(name for name in canonical_layers([LAYER, *layers]) if name != LAYER))
    return _Run(catalogue, store, names, progress, resend=resend, signer=signer).run(
        settings, id_prefix, max(1, workers)
    )


def packed_root(root: Root, url: str) -> bytes:
    """Return the unpacked bytes of a root; raise `MapDataError` if they are too many for readers."""
    unpacked = pack_root(root)
    if len(unpacked) > MAX_ROOT_BYTES:
        raise MapDataError(
            f"its index has {len(unpacked):,} bytes, more than {MAX_ROOT_BYTES:,}",
            path=url,
            cause="too_large",
            hint="publish it as several maps",
        )
    return unpacked


class _Run:
    """State of one run: the map it publishes, and the version that was current when it began."""

    def __init__(
        self,
        catalogue: Catalogue,
        store: Store,
        names: tuple[str, ...],
        progress: Progress,
        *,
        resend: bool,
        signer: MapSigner | None,
    ) -> None:
        self._catalogue = catalogue
        self._store = store
        self._names = names
        self._progress = progress
        self._resend = resend
        self._began_s = time.monotonic()
        self._signer = signer
        self._seen = begin_version(store, signer, "publish it")
        self._before: Root | None = self._read_root()
        self._shards: dict[tuple[int, int], tuple[bytes, int]] = {}  # last version: key, content, root row
        has_none = self._before is None and next(iter(store.list("blobs/")), None) is None
        self._look = not (resend or has_none)
        self._result = Published(len(catalogue), names)
        if self._seen.current is not None:
            self._result.current = self._seen.current.version

    def run(self, settings: PublishSettings, id_prefix: str, workers: int) -> Published:
        result, before, seen = self._result, self._before, self._seen
        result.id_prefix = self._prefix(id_prefix)
        result.encoding = settings.encoding or (before.encoding if before is not None else EXACT)
        side = shard_side(self._catalogue, len(self._names), before.shard_m if before is not None else None)
        with tempfile.TemporaryFile(prefix="shmmap-publish-") as known:  # without a name, it cannot be left
            path = f"/proc/{os.getpid()}/fd/{known.fileno()}"
            settings = msgspec.structs.replace(settings, is_first=not self._look, encoding=result.encoding)
            if write_known_objects(path, self._known_layers()):
                settings = msgspec.structs.replace(settings, known=path)
            objects = self._send_cells(settings, workers)
        if result.failures:
            return result
        result.objects = len(self._catalogue) * len(self._names)
        result.bytes = objects.nbytes
        unpacked = packed_root(self._root(side, self._send_shards(objects, side)), self._store.url)
        result.map_version = map_version_of(unpacked)
        is_same = before is not None and unpacked == pack_root(before)
        if seen.current is not None and is_same and not self._resend:
            result.root = seen.current.root
            if self._signer is not None:
                self._signer.keep(seen.current)
            self._progress.done(len(self._catalogue))
            return result
        entry = self._send_root(unpacked)
        switch_version(self._store, entry, seen, self._signer)
        result.version = result.current = entry.version
        self._progress.done(len(self._catalogue))
        return result

    # --- the version before ---------------------------------------------------------------------

    def _read_root(self) -> Root | None:
        if self._seen.current is None:
            return None
        try:
            return read_root(self._store, self._seen.current)
        except (MapMissing, MapDataError):
            if self._resend:
                return None
            raise

    def _prefix(self, wanted: str) -> str:
        url = self._store.url
        if wanted and not is_id_prefix(wanted):
            raise BadRequest(f"ids cannot begin with {wanted!r}", hint="a prefix begins and ends with /")
        if self._before is not None:
            if wanted not in ("", self._before.id_prefix):
                raise BadRequest(
                    f"ids of the map at {url} begin with {self._before.id_prefix}, in all its versions",
                    hint="publish to another URL for other ids",
                )
            return self._before.id_prefix
        if not wanted and self._seen.current is not None:
            raise BadRequest(
                f"the current version at {url} cannot be read: what do its ids begin with?",
                hint="name it: --id-prefix",
            )
        last = re.sub(r"[^\w.-]", "_", url.rpartition("/")[2]) or "map"
        return wanted or f"/{last}/"

    def _known_layers(self) -> Iterator[LayerObjects]:
        """Yield the objects of the version before, by shard and layer; none if everything is sent again."""
        root = self._before
        if root is None or self._resend:
            return
        self._progress.stage("read the current version", root.cells)
        for number, shard in enumerate(read_shards(self._store, root)):
            row, column = root.keys[number].tolist()
            self._shards[row, column] = sha256(pack_shard(shard)).digest(), number
            self._progress.advance(len(shard))
            yield from shard.layers.values()

    # --- sending --------------------------------------------------------------------------------

    def _send_cells(self, settings: PublishSettings, workers: int) -> CellObjects:
        """Send the objects of all cells to the store; failures are added to the result."""
        catalogue, result = self._catalogue, self._result
        objects = CellObjects(len(catalogue), self._names)
        versions = LayerVersions(lambda: catalogue)

        def tasks() -> Iterator[CellTask]:
            for index in range(len(catalogue)):
                task, crowded = task_of(catalogue, versions, index, self._names)
                if crowded:
                    result.failures.extend(crowded)
                    self._progress.advance(1)
                else:
                    yield task

        def finished(task: CellTask, done: CellSent | NotSent) -> None:
            if isinstance(done, CellSent):
                objects.set(task.number, done)
                if done.outside:
                    result.outside[task.cell_id] = done.outside
                for layer in done.layers:
                    self._count(layer.sent)
            else:
                result.failures.append(Failure(task.cell_id, done.layer, done.message))
            self._progress.advance(1)

        def died(task: CellTask, how: str) -> None:
            message = f"{task.source.name}: the worker died of it ({how})"
            result.failures.append(Failure(task.cell_id, ", ".join(task.layers), message))
            self._progress.advance(1)

        self._progress.stage("publish", len(catalogue))
        run_workers("shmmap.publishing.worker", settings, tasks(), workers, finished=finished, died=died)
        return objects

    def _count(self, sent_bytes: int) -> None:
        self._result.sent_objects += sent_bytes > 0
        self._result.sent_bytes += sent_bytes

    def _send_shards(self, objects: CellObjects, side: float) -> list[_ShardRow]:
        """Send new shards, and return the root's rows for all shards."""
        rows: list[_ShardRow] = []
        self._progress.stage("index", len(self._catalogue))
        divided = divide_into_shards(self._catalogue, objects, side)
        with RequestThreads(_SHARDS_PER_BATCH, "shard") as pool:
            while some := list(itertools.islice(divided, _SHARDS_PER_BATCH)):
                for row, sent_bytes in pool.map(self._send_shard, some):
                    rows.append(row)
                    self._count(sent_bytes)
                    self._progress.advance(row.cells)
        return rows

    def _send_shard(self, keyed: tuple[tuple[int, int], Shard]) -> tuple[_ShardRow, int]:
        key, shard = keyed
        unpacked = pack_shard(shard)
        content, number = self._shards.get(key, (b"", -1))
        if self._before is not None and content == sha256(unpacked).digest():
            size = int(self._before.sizes[number])
            return _ShardRow(key, len(shard), size, self._before.shard_sha256(number)), 0
        step("publish.shard")
        sent = send_packed(self._store, unpacked, look=self._look)
        return _ShardRow(key, len(shard), sent.size, sent.sha256), sent.sent_bytes

    def _root(self, side: float, rows: list[_ShardRow]) -> Root:
        catalogue = self._catalogue
        largest_x, largest_y = (catalogue.boxes[:, 2:] - catalogue.boxes[:, :2]).max(axis=0).tolist()
        bounds = catalogue.bounds
        assert bounds is not None  # noqa: S101  a catalogue without cells is not loaded
        return Root(
            id_prefix=self._result.id_prefix,
            frame_id=catalogue.frame_id,
            crs=catalogue.frame.crs,
            origin=catalogue.frame.origin,
            unit_m=catalogue.frame.unit_m,
            encoding=self._result.encoding,
            cells=len(catalogue),
            bounds=bounds,
            shard_m=side,
            largest_m=(largest_x, largest_y),
            mean_m=catalogue.mean_size,
            layers={name: layer_spec(name).builder_version for name in self._names},
            keys=np.array([row.key for row in rows], np.int32),
            counts=np.array([row.cells for row in rows], np.uint32),
            sizes=np.array([row.size for row in rows], np.uint32),
            hashes=np.frombuffer(b"".join(row.sha256 for row in rows), np.uint8).reshape(-1, 32),
        )

    def _send_root(self, unpacked: bytes) -> Entry:
        step("publish.root")
        root = send_packed(self._store, unpacked, look=self._look)
        self._result.root = root.sha256.hex()
        self._count(root.sent_bytes)
        refuse_if_late(
            self._began_s,
            f"publishing to {self._store.url}",
            "run the same command again: what was sent within a day is not sent again",
        )
        step("version.entry")
        return new_entry(self._store, self._result.root, root.size, self._seen.current)
