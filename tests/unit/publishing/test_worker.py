# SPDX-License-Identifier: Apache-2.0
"""What a publishing worker makes of a cell: the objects of its layers, from the cache where it can."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from shmmap.layers import build
from shmmap.layers.build import make_layer
from shmmap.layers.disk_cache import LayerCache
from shmmap.layers.sources import CellJob, Files
from shmmap.layers.spec import layer_spec
from shmmap.prepare.task_pool import CellTask
from tests.support.divided_map import DividedMap, make_map

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.publishing import worker
from shmmap.publishing.messages import KnownObjects
from shmmap.publishing.worker import CellMaker, LayerRefused
from shmmap.segment.version import Source

LAYERS = ("points", "sample(every=2)", "sample(count=50)")


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "town", columns=1, rows=1, points=200)


def task_of(town: DividedMap, layers: tuple[str, ...] = LAYERS) -> CellTask:
    (name,) = town.corners
    specs = tuple(str(layer_spec(layer)) for layer in layers)
    return CellTask(
        0, town.id(name), Source(town.id(name)), town.box(name), "map", specs, tuple(() for _ in specs)
    )


def test_layers_prepared_before_come_out_of_the_cache(
    town: DividedMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(town)
    made = CellMaker(KnownObjects(""), None).make(task)
    cache = LayerCache(str(tmp_path / "cache"), limit_bytes=1 << 30)
    cache.make()
    for layer in task.layers:
        fd = os.memfd_create("layer")
        job = CellJob(task.cell_id, task.source, task.box, task.frame_id, ())
        make_layer(layer_spec(layer), job, fd, cache=cache, keep=True)
        os.close(fd)

    def built(*arguments: object, **options: object) -> None:
        raise AssertionError("it is there already")

    monkeypatch.setattr(build, "derive", built)
    monkeypatch.setattr(Files, "fill", built)
    again = CellMaker(KnownObjects(""), cache).make(task)
    assert [layer.name for layer in again.layers] == [layer.name for layer in made.layers]
    assert [layer.frame for layer in again.layers] == [layer.frame for layer in made.layers]
    with pytest.raises(LayerRefused, match="it is there already"):
        CellMaker(KnownObjects(""), None).make(task)


def test_a_layer_that_is_too_large_is_refused(town: DividedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "MAX_OBJECT_BYTES", 4096)
    with pytest.raises(LayerRefused) as refused:
        CellMaker(KnownObjects(""), None).make(task_of(town))
    assert refused.value.layer == "points"
    assert "more than the 4.0 KiB" in refused.value.message
    assert refused.value.hint == "divide the map into smaller cells"


def test_a_file_that_changes_meanwhile_is_refused(town: DividedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    task = task_of(town)
    make = build.make_layer

    def slowly(*arguments: object, **options: object) -> object:
        made = make(*arguments, **options)  # type: ignore[arg-type]
        town.change(next(iter(town.corners)), seed=3, count=200)
        return made

    monkeypatch.setattr(worker, "make_layer", slowly)
    with pytest.raises(LayerRefused, match="the file changed while it was read"):
        CellMaker(KnownObjects(""), None).make(task)
