# SPDX-License-Identifier: Apache-2.0
"""Prepares a whole map: worker processes on all cores compute the layers of every cell.

A run may be stopped at any moment.  The next run continues there: it only checks the layers that are in the
cache already.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from shmmap.layers.disk_cache import LayerCache
from shmmap.layers.sources import Neighbour
from shmmap.layers.spec import canonical_layers
from shmmap.layers.versions import MAX_NEIGHBOURS, LayerVersions
from shmmap.origin.catalogue import Catalogue
from shmmap.prepare.task_pool import CellDone, CellTask, TaskPool, decode_done
from shmmap.progress import Progress


@dataclass(frozen=True, slots=True)
class Failure:
    """A layer that could not be prepared."""

    cell_id: str
    layer: str
    message: str


@dataclass(slots=True)
class Prepared:
    """Result of a run: layers counted by how they got into the cache; ``bytes`` is their total size."""

    cells: int
    kept: int = 0
    recognised: int = 0
    built: int = 0
    bytes: int = 0
    cache_bytes: int = 0
    failures: list[Failure] = field(default_factory=list)


def prepare_map(
    catalogue: Catalogue,
    layers: Sequence[str],
    *,
    cache_dir: str,
    cache_bytes: int,
    workers: int,
    progress: Progress,
) -> Prepared:
    """Compute layers of every cell of a map into the disk cache.

    Parameters
    ----------
    layers
        Specs of the layers, in any form.
    cache_dir, cache_bytes
        Directory of the cache, and its size limit; the least recently used entries are evicted.
    workers
        Number of worker processes.

    Raises
    ------
    BadRequest
        A layer is unknown.
    CannotWrite
        ``cache_dir`` cannot be written.
    """
    names = canonical_layers(layers)
    cache = LayerCache(cache_dir, limit_bytes=cache_bytes)
    cache.make()
    versions = LayerVersions(lambda: catalogue)
    recognise = int(not cache.is_empty)
    crowded: list[Failure] = []
    result = Prepared(len(catalogue))

    def tasks() -> Iterator[CellTask]:
        for index in range(len(catalogue)):
            task, refused = task_of(catalogue, versions, index, names)
            crowded.extend(refused)
            yield task

    def finished(task: CellTask, done: CellDone) -> None:
        for layer in done.layers:
            result.kept += layer.how == "kept"
            result.recognised += layer.how == "recognised"
            result.built += layer.how == "built"
            result.bytes += layer.bytes
            if layer.how == "failed":
                result.failures.append(Failure(task.cell_id, layer.layer, layer.message))
        progress.advance(1)

    def died(task: CellTask, how: str) -> None:
        message = f"{task.source.name}: the worker died of it ({how})"
        result.failures.extend(Failure(task.cell_id, layer, message) for layer in task.layers)
        progress.advance(1)

    progress.stage("prepare", len(catalogue))
    TaskPool(
        "shmmap.prepare.worker",
        [cache_dir, str(cache_bytes), str(recognise)],
        workers=max(1, workers),
        decode=decode_done,
        finished=finished,
        died=died,
    ).run(tasks())
    result.failures += crowded
    result.cache_bytes = cache.budget.trim()
    progress.done(len(catalogue))
    return result


def task_of(
    catalogue: Catalogue, versions: LayerVersions, index: int, layers: Sequence[str]
) -> tuple[CellTask, list[Failure]]:
    """Return the task for a cell's layers, and failures for layers that would use too many neighbours."""
    around: dict[str, tuple[Neighbour, ...]] = {}
    crowded: list[Failure] = []
    for layer in layers:
        near = versions.neighbours(index, layer)
        if len(near) > MAX_NEIGHBOURS:
            message = f"{layer} looks into more than {MAX_NEIGHBOURS} cells around one"
            crowded.append(Failure(catalogue.id(index), layer, message))
        else:
            around[layer] = tuple(
                Neighbour.of(catalogue.id(i), catalogue.source(i), catalogue.box(i)) for i in near
            )
    task = CellTask(
        index,
        catalogue.id(index),
        catalogue.source(index),
        catalogue.box(index),
        catalogue.frame_id,
        tuple(around),
        tuple(around.values()),
    )
    return task, crowded
