# SPDX-License-Identifier: Apache-2.0
"""Computed layers from a daemon: built once, of the right points, under one name, without delay to others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.layers.build import build_layer
from shmmap.layers.contract import LayerTable
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap, random_points
from tests.support.layer_oracles import install
from tests.support.raw_client import DaemonError, RawCells, RawClient, RawHandle, circle, pack_versions
from tests.support.segment_reader import read_segment
from tests.support.skips import open3d_or_skip

pytestmark = pytest.mark.usefixtures("layer_kernels")

Connect = Callable[..., RawClient]
NDT = "ndt(leaf=2.0,min_points=3)"


def ask(client: RawClient, layers: list[str], *, area: Any = None, wait: float = 60.0) -> RawCells:
    return client.cells_reply(client.ask("area", area or circle(0.0, 0.0, 5.0), layers, wait, None))


def cloud(made: DividedMap, name: str) -> dict[str, Any]:
    """What build_layer takes, read independently of the daemon."""
    source = made.points(name)
    return {"xyz": np.column_stack([source["x"], source["y"], source["z"]]), "intensity": source["intensity"]}


def assert_is(client: RawClient, handle: RawHandle, made: DividedMap, table: LayerTable) -> None:
    """The segment holds this table and says where it comes from."""
    segment = read_segment(client.path(handle))
    assert list(segment.columns) == list(table.columns)
    for name, column in table.columns.items():
        assert segment.columns[name].dtype == column.dtype
        assert np.array_equal(segment.columns[name], column), name
    assert segment.fields["layer"] == handle.layer
    assert segment.fields["rows"] == handle.points == table.rows
    assert segment.units == {name: table.units.get(name, "") for name in table.columns}
    z = made.points(handle.id.rsplit("/", 1)[1])["z"]
    assert segment.fields["z"] == (z.min(), z.max())
    assert segment.fields["source_points"] == len(z)
    assert (segment.epoch, segment.version) == (client.epoch, handle.version)


def test_only_what_is_asked_for_is_resident(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    client = connect(daemon(divided_map.root))
    reply = ask(client, ["ndt( 2 , min_points = 3)"])
    assert len(reply.cells) == 4
    for handle in reply.cells:
        assert handle.layer == NDT
        name = handle.id.rsplit("/", 1)[1]
        assert_is(client, handle, divided_map, build_layer(NDT, cloud(divided_map, name)))
    again = ask(client, [NDT, "ndt(min_points=3,leaf=2.0)"])
    assert [h.segment for h in again.cells] == [h.segment for h in reply.cells]


def test_resident_segments_are_the_layers_asked_for(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    ask(client, [NDT])
    assert len(one.segments()) == 4
    both = ask(client, ["points", NDT, "voxel(leaf=0.5)", "ndt(leaf=2.0,min_points=2,of=voxel(leaf=0.5))"])
    assert len(one.segments()) == 16
    assert [handle.layer.partition("(")[0] for handle in both.cells] == ["points", "ndt", "voxel", "ndt"] * 4
    for handle in both.cells:
        name = handle.id.rsplit("/", 1)[1]
        assert_is(client, handle, divided_map, build_layer(handle.layer, cloud(divided_map, name)))
    assert len({handle.version for handle in both.cells}) == 16  # each layer has its own


def test_a_layer_made_of_points_in_memory_is_the_same(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    client = connect(daemon(divided_map.root))
    ask(client, ["points"])
    for handle in ask(client, ["voxel(leaf=1.0)"]).cells:
        name = handle.id.rsplit("/", 1)[1]
        assert_is(client, handle, divided_map, build_layer("voxel(leaf=1.0)", cloud(divided_map, name)))


def test_what_is_no_layer_is_refused(standing: DaemonProcess, connect: Connect) -> None:
    client = connect(standing)
    for spec in ("ndt", "nonsense(1)", "ndt(leaf=-1)", "ndt(leaf=2", "a" * 300, ""):
        with pytest.raises(DaemonError) as caught:
            ask(client, [spec])
        assert caught.value.code == "bad_request"
    assert len(ask(client, ["points"]).cells) == 4


def test_a_differential_request_holds_layers_apart(standing: DaemonProcess, connect: Connect) -> None:
    client = connect(standing)
    first = ask(client, [NDT])
    held = [[handle.id, handle.version, [NDT]] for handle in first.cells]
    area = circle(0.0, 0.0, 5.0)
    reply = client.cells_reply(client.ask("differential", area, ["points", NDT], held, b"", 60.0, None))
    assert [handle.layer for handle in reply.cells] == ["points"] * 4
    packed = pack_versions([handle.version for handle in first.cells])
    reply = client.cells_reply(client.ask("differential", area, [NDT], [], packed, 60.0, None))
    assert (reply.cells, reply.removed) == ([], [])


def test_a_window_of_two_layers(standing: DaemonProcess) -> None:
    with shmmap.connect(standing.endpoint) as client:
        found = client.around(0.0, 0.0, 5.0, layers=["points", "ndt(2)"], wait=60.0)
        layers = {cell.layer for cell in found}
        assert layers == {"points", "ndt(leaf=2.0)"}
        for cell in found:
            assert (cell.lattice is None) is (cell.layer == "points")
            cell.verify()
        del found, cell


def test_a_window_follows_layers_however_they_are_written(standing: DaemonProcess) -> None:
    with shmmap.MapWindow(standing.endpoint, 30, layers="voxel( 1 )", update_distance=0) as window:
        for x in (0.0, 15.0):
            window.move_to(x, 0.0)
            window.wait_until_current(60)
            assert {cell.layer for cell in window.cells} == {"voxel(leaf=1.0)"}
            near = window.points_around(x, 0.0, 5.0)
            assert near.count() > 0
            assert window.points_around(x, 0.0, 5.0, layer="voxel(leaf=1.0)").count() == near.count()
            del near


def test_points_around_finds_each_layer_of_a_window_as_it_was_asked_for(standing: DaemonProcess) -> None:
    asked = ["voxel( 1 )", "points"]
    with shmmap.MapWindow(standing.endpoint, 30, layers=asked) as window:
        assert window.points_around(0.0, 0.0, 5.0).count() == 0
        window.move_to(0.0, 0.0, wait=60)
        voxels = window.points_around(0.0, 0.0, 5.0).count()
        assert 0 < voxels <= window.points_around(0.0, 0.0, 5.0, layer="points").count()
        for written in ("voxel( 1 )", "voxel(leaf=1.0)"):
            assert window.points_around(0.0, 0.0, 5.0, layer=written).count() == voxels
        for other in ("voxel(leaf=2.0)", "ndt(leaf=2.0)"):
            with pytest.raises(shmmap.BadRequest, match="no layer"):
                window.points_around(0.0, 0.0, 5.0, layer=other)


def offered(tmp_path: Path) -> dict[str, str]:
    return {"PYTHONPATH": f"{ROOT}:{install(tmp_path / 'offered')}"}


def counts(client: RawClient, cells: RawCells) -> dict[str, list[int]]:
    return {
        handle.id.rsplit("/", 1)[1]: read_segment(client.path(handle)).columns["counts"].tolist()
        for handle in cells.cells
    }


def expected_around(made: DividedMap, name: str, radius: float) -> list[int]:
    """How many points lie in a cell, and within the radius of its box in other files."""
    x0, y0, x1, y1 = made.box(name)
    near = 0
    for other in made.corners:
        if other != name:
            xyz = made.points(other)
            inside = (xyz["x"] >= x0 - radius) & (xyz["x"] <= x1 + radius)
            near += int((inside & (xyz["y"] >= y0 - radius) & (xyz["y"] <= y1 + radius)).sum())
    return [len(made.points(name)["x"]), near]


def test_a_kind_of_another_package_with_a_halo(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, tmp_path: Path
) -> None:
    client = connect(daemon(divided_map.root, environment=offered(tmp_path)))
    assert "around(radius)" in client.layers
    everything = circle(0.0, 0.0, 100.0)
    before = ask(client, ["around(5)"], area=everything)
    assert len(before.cells) == 36
    for name, found in counts(client, before).items():
        assert found == expected_around(divided_map, name, 5.0), name
    # one file changes: its own layer and its eight neighbours' are other versions now
    changed = "0_0.pcd"
    fewer = random_points(np.random.default_rng(9), (0, 0), 100)
    divided_map.write_cell(changed, (0, 0), fewer)
    client.ask("reload")
    held = pack_versions([handle.version for handle in before.cells])
    reply = client.cells_reply(
        client.ask("differential", everything, ["around(radius=5.0)"], [], held, 60.0, None)
    )
    near = {f"{x}_{y}.pcd" for x in (-20, 0, 20) for y in (-20, 0, 20)}
    assert {handle.id.rsplit("/", 1)[1] for handle in reply.cells} == near
    for name, found in counts(client, reply).items():
        assert found == expected_around(divided_map, name, 5.0), name
    assert reply.removed_versions == []
    again = ask(client, ["around(5)"], area=everything)
    assert {h.id: h.segment for h in again.cells}.items() >= {h.id: h.segment for h in reply.cells}.items()
    assert len(again.cells) == 36


@pytest.mark.slow
def test_normals_have_no_seam(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    open3d_or_skip()
    client = connect(daemon(divided_map.root))
    name, radius = "0_0.pcd", 4.0
    reply = client.cells_reply(
        client.ask(
            "selected", [divided_map.id(name)], ["normals(radius=4)", "crop(z_max=4,of=denoise)"], 60.0
        )
    )
    assert reply.failed == []
    for handle, reach in zip(reply.cells, (radius, 1.0), strict=True):
        x0, y0, x1, y1 = divided_map.box(name)
        near = []
        for other in sorted(set(divided_map.in_circle(x0 + 10, y0 + 10, 20)) - {name}):
            xyz = cloud(divided_map, other)["xyz"]
            inside = (xyz[:, 0] >= x0 - reach) & (xyz[:, 0] <= x1 + reach)
            near.append(xyz[inside & (xyz[:, 1] >= y0 - reach) & (xyz[:, 1] <= y1 + reach)])
        alone = build_layer(handle.layer, cloud(divided_map, name))
        whole = build_layer(handle.layer, cloud(divided_map, name), halo=np.concatenate(near))
        assert_is(client, handle, divided_map, whole)
        last = list(whole.columns)[-1]
        assert not np.array_equal(alone[last], whole[last])


@pytest.mark.parametrize("how", [0, 1])
def test_a_builder_that_fails_costs_its_own_layer(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, tmp_path: Path, how: int
) -> None:
    one = daemon(divided_map.root, environment=offered(tmp_path))
    client = connect(one)
    ids = [divided_map.id("0_0.pcd")]
    reply = client.cells_reply(client.ask("selected", ids, [f"broken({how})", "points"], 60.0))
    assert [(failure.code, failure.layer) for failure in reply.failed] == [
        ("load_failed", "broken(how=1)" if how else "broken")
    ]
    assert ("defect" if how == 0 else "died") in reply.failed[0].message
    assert [handle.layer for handle in reply.cells] == ["points"]
