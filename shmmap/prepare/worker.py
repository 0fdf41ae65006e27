# SPDX-License-Identifier: Apache-2.0
"""Preparing worker: a process that builds the layers of one cell after the other.

A file that crashes the worker fails only its own cell.  The worker ends with the process that started it.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from typing import Final

import xxhash

from shmmap.errors import ShmmapError
from shmmap.layers.build import cache_key, combined_digest, keep_layer
from shmmap.layers.contract import Box
from shmmap.layers.disk_cache import CacheKey, LayerCache
from shmmap.layers.points import LAYER
from shmmap.layers.sources import FILES, CellJob, CellSource, SourceReader
from shmmap.layers.spec import LayerSpec, layer_spec
from shmmap.prepare.task_pool import CellDone, CellTask, LayerDone, Ready, decode_task, encode
from shmmap.processes.request_threads import leave
from shmmap.processes.start_child import MAX_PACKET_BYTES, channel_to_parent
from shmmap.segment.version import Source

_NICENESS: Final = 5
_BLOCK_BYTES: Final = 1 << 20


def _prepare_cell(task: CellTask, cache: LayerCache, *, recognise: bool) -> CellDone:
    """Compute every layer of a cell into the cache; the file is read once for all computed layers.

    ``recognise``: search the cache for layers of the same content under other versions.
    """
    done: dict[str, LayerDone] = {}
    missing: list[tuple[LayerSpec, CellJob, CacheKey]] = []
    for name, around in zip(task.layers, task.around, strict=True):
        spec = layer_spec(name)
        job = CellJob(task.cell_id, task.source, task.box, task.frame_id, around)
        key = cache_key(spec, job)
        if key is None:
            done[name] = LayerDone(name, "failed", 0, f"{task.source.name}: it cannot be looked at")
        elif cache.has(key):
            done[name] = LayerDone(name, "kept", cache.size_of(key))
        else:
            missing.append((spec, job, key))
    if missing and recognise:
        digests: dict[str, bytes] = {}
        for entry in list(missing):
            spec, job, key = entry
            if cache.recognise(key, _content(job, digests)):
                done[str(spec)] = LayerDone(str(spec), "recognised", cache.size_of(key))
                missing.remove(entry)
    source = CellPoints(task.source, task.box, [spec for spec, _, _ in missing])
    for spec, job, _ in missing:
        done[str(spec)] = _build(spec, job, cache, source)
    return CellDone(task.number, tuple(done[name] for name in task.layers))


class CellPoints:
    """A cell's points, read at the first use, with all columns that any of the layers needs."""

    def __init__(
        self, source: Source, box: Box, specs: list[LayerSpec], reader: SourceReader = FILES
    ) -> None:
        self._reader = reader
        self._source = source
        self._box = box
        self._read: CellSource | None = None
        needs = [spec.source_columns for spec in specs if spec.kind.name != LAYER]
        self._needs: tuple[str, ...] | None = (
            None if None in needs else tuple({name for some in needs if some is not None for name in some})
        )

    def points(self, spec: LayerSpec) -> CellSource:
        """Return the cell's points with exactly the columns that one layer uses."""
        if self._read is None:
            self._read = self._reader.read(self._source, self._box, self._needs)
        names = spec.source_columns
        table = self._read.points
        columns = {n: c for n, c in table.columns.items() if names is None or n in names}
        units = {n: u for n, u in table.units.items() if n in columns}
        return replace(self._read, points=replace(table, columns=columns, units=units))


def _build(spec: LayerSpec, job: CellJob, cache: LayerCache, source: CellPoints) -> LayerDone:
    name = str(spec)
    try:
        return LayerDone(name, "built", keep_layer(spec, job, cache, source=lambda: source.points(spec)))
    except ShmmapError as error:
        message = str(error)
    except OSError as error:
        message = f"{error.filename or job.source.name}: {error.strerror or error}"
    except MemoryError:
        message = f"{job.source.name}: building {name} ran out of memory"
    except Exception as error:  # noqa: BLE001  e.g. in another package's builder: only this layer fails
        message = f"{job.source.name}: building {name} failed: {error!r}"
    return LayerDone(name, "failed", 0, message[:2000])


def _content(job: CellJob, known: dict[str, bytes]) -> bytes:
    """Return the digest of a layer's input files, each read once; an unreadable file counts as zeros."""
    around = [near.source.name for near in job.neighbours]
    for path in (job.source.name, *around):
        if path not in known:
            known[path] = _digest(path)
    return combined_digest(known[job.source.name], [known[path] for path in around])


def _digest(path: str) -> bytes:
    digest = xxhash.xxh3_128()
    try:
        with open(path, "rb", buffering=0) as file:
            while block := file.read(_BLOCK_BYTES):
                digest.update(block)
    except OSError:
        return bytes(16)
    return digest.digest()


def main(arguments: list[str]) -> int:
    """Run with ``CHANNEL_FD PARENT_PID CACHE_DIR CACHE_BYTES RECOGNISE``, the last 0 or 1."""
    channel = channel_to_parent(arguments)
    os.nice(_NICENESS)
    cache = LayerCache(arguments[2], limit_bytes=int(arguments[3]))
    recognise = bool(int(arguments[4]))
    try:
        channel.send(encode(Ready()))
        while data := channel.recv(MAX_PACKET_BYTES):
            task = decode_task(data)
            channel.send(encode(_prepare_cell(task, cache, recognise=recognise)))
    except (BrokenPipeError, ConnectionResetError):
        pass
    return 0


if __name__ == "__main__":
    leave(main(sys.argv[1:]))
