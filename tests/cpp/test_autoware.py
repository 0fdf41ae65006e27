# SPDX-License-Identifier: Apache-2.0
"""`PcdLoader` and `NdtLeaves` in a node that does what Autoware's scan matcher does with them."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import shmmap
from tests.cpp.conftest import DaemonFactory
from tests.support.autoware_node import NODE, TYPES, AutowareNode, compiled_with
from tests.support.compiled_programs import built_once
from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import DaemonProcess, stop
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.skips import programs_or_skip

EVERYTHING = (0.0, 0.0, 500.0)
FIELDS = "x:0:7:1 y:4:7:1 z:8:7:1 intensity:12:7:1 "
NAMES = {"f4": 7, "f8": 8, "i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6}


@pytest.fixture(scope="module", params=TYPES)
def node_program(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the compiled node."""
    programs_or_skip("g++")
    types = request.param
    program = built_once(tmp_path_factory, f"node-{types}", lambda folder: compiled_with(types, NODE, folder))
    if program is None:
        pytest.skip("ROS 2's generator of messages is missing (rosidl-generator-c-cpp, python3-rosidl)")
    return program


@pytest.fixture
def node(node_program: Path, daemon: DaemonFactory) -> Iterator[AutowareNode]:
    """Return a node that has no loader yet; nothing in it may leak or go wrong."""
    one = AutowareNode(node_program)
    yield one
    assert one.close() == 0


def of(answer: list[list[str]], kind: str) -> list[list[str]]:
    """What stands on the lines of a kind."""
    return [line[1:] for line in answer if line[0] == kind]


def plain(name: str) -> str:
    """Return the cell id of a name that carries a version."""
    cell_id, version = re.fullmatch(r"(.*)@([0-9a-f]{16})", name, re.DOTALL).groups()  # type: ignore[union-attr]
    assert version != "0" * 16
    return str(cell_id)


def names(answer: list[list[str]], kind: str) -> list[str]:
    """Base names of the cells on the lines of a kind."""
    return [Path(plain(line[0])).name for line in of(answer, kind)]


def crc_of(path: Path) -> str:
    """Checksum of the points of a PCD file."""
    return str(zlib.crc32(data_of(path)))


def versions(one: DaemonProcess) -> dict[str, int]:
    """Present version of each cell, as another client sees it."""
    with shmmap.connect(one.endpoint) as python:
        return {cell.id: cell.version for cell in python.metadata()}


def change(one: DaemonProcess, made: DividedMap, name: str, seed: int) -> None:
    """Give a cell other points, and have the daemon notice."""
    made.change(name, seed=seed)
    with shmmap.connect(one.endpoint) as python:
        python.reload()


def data_of(path: Path) -> bytes:
    """The points of a binary PCD file, which Autoware's loader passes on as they are."""
    return path.read_bytes().split(b"DATA binary\n", 1)[1]


def record_of(cell: shmmap.Cell) -> NDArray[Any]:
    """A cell's points as a message has them: x, y, z in 32 bits, then every other column."""
    xyz = cell.xyz.astype(np.float32)
    columns = {name: xyz[:, axis] for axis, name in enumerate("xyz")}
    columns.update({name: cell[name] for name in cell.columns if name != "xyz"})
    record = np.zeros(len(xyz), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        record[name] = values
    return record


def test_cells_are_those_of_autoware_s_loader(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap
) -> None:
    """To the byte: fields, points, boxes; in the order of ids."""
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 5)
    answer = node.ask("update", 5, 5, 30)
    assert answer[0] == ["header", "map", "0", "0"]
    wanted = divided_map.in_square(5, 5, 30)
    assert len(wanted) == 16
    version = versions(one)
    expected = []
    for name in wanted:
        x0, y0, x1, y1 = (f"{side:g}" for side in divided_map.box(name))
        crc = zlib.crc32(data_of(divided_map.pcd_dir / name))
        layout = "1 500 16 8000 01"
        named = f"{divided_map.id(name)}@{version[divided_map.id(name)]:016x}"
        expected.append([named, f"{x0} {y0} {x1} {y1}", layout, FIELDS, str(crc)])
    assert of(answer, "cell") == expected
    assert of(answer, "remove") == []


def test_fields_of_every_kind(daemon: DaemonFactory, node: AutowareNode, tmp_path: Path) -> None:
    """Coordinates of 64 bits are rounded, integers of 64 bits left out: neither PCL nor ROS has them."""
    made = make_map(tmp_path / "map", columns=2, rows=1)
    rng = np.random.default_rng(2)
    kinds = {kind: rng.integers(0, 100, 3000).astype(kind) for kind in NAMES}
    xyz = random_points(rng, (0, 0), 3000)
    double = {axis: xyz[axis].astype(np.float64) + 1e-9 for axis in "xyz"}
    made.write_cell("0_0.pcd", (0, 0), {**double, **kinds, "long": np.arange(3000, dtype=np.uint64)})
    made.write_cell("-20_0.pcd", (-20, 0), {axis: xyz[axis][:1] - 20 for axis in "xyz"})
    one = daemon(made.root)
    node.ask("loader", one.endpoint, 60, 5)
    small, large = of(node.ask("update", *EVERYTHING), "cell")
    assert small[2:4] == ["1 1 12 12 01", "x:0:7:1 y:4:7:1 z:8:7:1 "]
    with shmmap.connect(one.endpoint) as python:
        cells = {cell.id: cell for cell in python.around(0, 0, radius=500).raise_for_failures()}
    record = record_of(cells[plain(large[0])])
    assert record.dtype.names is not None
    kept = [name for name in record.dtype.names if name != "long"]
    packed = np.zeros(3000, [(name, record.dtype[name]) for name in kept])
    offsets = ""
    for name in kept:
        packed[name] = record[name]
        dtype, offset = packed.dtype.fields[name][:2]  # type: ignore[index]
        offsets += f"{name}:{offset}:{NAMES[dtype.str[1:]]}:1 "
    step = packed.dtype.itemsize
    assert large[2:] == [f"1 3000 {step} {3000 * step} 01", offsets, str(zlib.crc32(packed.tobytes()))]


def test_real_maps_too(daemon: DaemonFactory, node: AutowareNode, data_dir: Path) -> None:
    one = daemon(data_dir / "kitti0005_map" / "map_static_v005.pcd")
    node.ask("loader", one.endpoint, 120, 5)
    answer = of(node.ask("update", 0, 0, 1e6), "cell")
    with shmmap.connect(one.endpoint) as python:
        cells = python.around(0.0, 0.0, radius=1e6, wait=120.0).raise_for_failures()
        expected = [
            [f"{cell.id}@{cell.version:016x}", str(zlib.crc32(record_of(cell).tobytes()))] for cell in cells
        ]
    assert [[line[0], line[4]] for line in answer] == expected
    assert sum(len(cell.xyz) for cell in cells) > 1e6


def test_along_a_drive_the_node_holds_what_autoware_s_area_has(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 5)
    held: set[str] = set()
    for x in range(-70, 71, 10):
        answer = node.ask("update" if x % 20 else "const", x, 3, 25)
        added, removed = names(answer, "cell"), names(answer, "remove")
        assert not set(added) & set(removed)
        assert not set(added) & held
        assert set(removed) <= held
        held = held | set(added) - set(removed)
        held -= set(removed)
        assert sorted(held) == sorted(divided_map.in_square(x, 3, 25))


def test_a_changed_cell_comes_under_a_new_name(
    daemon: DaemonFactory, node: AutowareNode, node_program: Path, divided_map: DividedMap
) -> None:
    """Once to each requester, over restarts; one that keeps the first of an id gets it, too."""
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 30)
    other = AutowareNode(node_program)
    other.ask("loader", one.endpoint, 60, 30)
    cell_id = divided_map.id("0_0.pcd")
    old = f"{cell_id}@{versions(one)[cell_id]:016x}"
    for requester in (node, other):
        assert len(of(requester.ask("update", *EVERYTHING), "cell")) == 36
    change(one, divided_map, "0_0.pcd", seed=7)
    new = f"{cell_id}@{versions(one)[cell_id]:016x}"
    assert new != old
    answer = node.ask("update", *EVERYTHING)
    assert [line[0] for line in of(answer, "cell")] == [new]
    assert of(answer, "remove") == [[old]]
    one.stop()
    one.start()
    other.ask("loader", one.endpoint, 60, 30)
    assert other.ask("update", *EVERYTHING) == answer
    for requester in (node, other):
        assert requester.ask("update", *EVERYTHING) == [["header", "map", "0", "0"]]
        held = dict(requester.ask("held"))
        assert len(held) == 36
        assert held[new] == crc_of(divided_map.pcd_dir / "0_0.pcd")
    change(one, divided_map, "0_0.pcd", seed=8)
    assert names(other.ask("update", *EVERYTHING), "cell") == ["0_0.pcd"]
    assert other.close() == 0


def test_ids_that_were_not_handed_out(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap
) -> None:
    """Plain ids are outdated: what they name comes under its name. All are removed, each once."""
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 5)
    inside, outside = divided_map.id("0_0.pcd"), divided_map.id("-60_-60.pcd")
    version = versions(one)
    right, wrong = f"{inside}@{version[inside]:016x}", f"{inside}@{version[outside]:016x}"
    foreign = ["unknown.pcd", outside, f"{outside}@{version[outside]:016x}", inside, "/nowhere/0_0.pcd"]
    foreign += [f"/nowhere/0_0.pcd@{7:016x}", "40_40.pcd", f"0_0.pcd@{version[inside]:016x}", "@", wrong]
    foreign += [right.upper(), right[:-1], f"{right}0", f"{inside}@{version[inside]:016X}"]
    held = [foreign[0], *foreign, inside]
    answer = node.ask("ask", 10, 10, 0, ";".join(held))
    assert [line[0] for line in of(answer, "cell")] == [right]
    assert [line[0] for line in of(answer, "remove")] == list(dict.fromkeys(held))
    answer = node.ask("ask", 10, 10, 0, ";".join([*held, right, right]))
    assert of(answer, "cell") == []
    assert [line[0] for line in of(answer, "remove")] == list(dict.fromkeys(held))


def test_ids_without_versions(daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap) -> None:
    """As from Autoware's loader: a plain id is current whatever its file is, and the only one."""
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 5, 10**9, "plain")
    answer = node.ask("update", *EVERYTHING)
    assert [line[0] for line in of(answer, "cell")] == sorted(map(divided_map.id, divided_map.corners))
    assert {line[0] for line in node.ask("grids", *EVERYTHING)} == {"grid"}
    change(one, divided_map, "0_0.pcd", seed=7)
    assert node.ask("update", *EVERYTHING) == [["header", "map", "0", "0"]]
    assert len(of(node.ask("update", 0, 0, 0), "remove")) == 32
    named = f"{divided_map.id('0_0.pcd')}@{versions(one)[divided_map.id('0_0.pcd')]:016x}"
    answer = node.ask("ask", 10, 10, 0, named)
    assert [line[0] for line in of(answer, "cell")] == [divided_map.id("0_0.pcd")]
    assert of(answer, "remove") == [[named]]


def test_names_of_cells(node: AutowareNode) -> None:
    """They are split at the last ``@`` before 16 digits, and at no other."""
    for cell_id in ("/a.pcd", "/a@b/c@.pcd", "/a@0123456789abcdef", "/a b@0123456789abcdef@0.pcd"):
        for version in (1, 0x1234ABC, 2**63 + 5, 2**64 - 1):
            name = f"{cell_id}@{version:016x}"
            assert node.ask("name", cell_id, version) == [[name]]
            assert node.ask("split", name) == [[cell_id, str(version)]]
    for text in (
        "/a.pcd",
        "/a@0123456789ABCDEF",
        "/a@123456789abcdef",
        "/a@00123456789abcdef",
        "/0123456789abcdef",
    ):
        assert node.ask("split", text) == [[text, "none"]]


def test_paths_that_look_like_names(daemon: DaemonFactory, node: AutowareNode, tmp_path: Path) -> None:
    """A path may hold ``@``, and what looks like a version."""
    made = make_map(tmp_path / "a@b" / f"map@{5:016x}", columns=2, rows=1)
    made.write_cell(f"0_0@{7:016x}.pcd", (20, 0), made.points("0_0.pcd"))
    made.write_metadata()
    one = daemon(made.root)
    node.ask("loader", one.endpoint, 60, 5)
    answer = node.ask("update", *EVERYTHING)
    assert [plain(line[0]) for line in of(answer, "cell")] == sorted(map(made.id, made.corners))
    assert node.ask("update", *EVERYTHING) == [["header", "map", "0", "0"]]
    change(one, made, f"0_0@{7:016x}.pcd", seed=4)
    answer = node.ask("update", *EVERYTHING)
    assert names(answer, "cell") == names(answer, "remove") == [f"0_0@{7:016x}.pcd"]
    assert of(answer, "cell")[0][0] != of(answer, "remove")[0][0]


def test_more_than_an_answer_can_have(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap
) -> None:
    """The nearest cells come, and an error; the next answers bring the others, and remove none."""
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 30, 10 * 8000 + 100)
    held: list[str] = []
    while True:
        answer = node.ask("update", 5, 7, 500)
        cells = names(answer, "cell")
        assert names(answer, "remove") == []
        if not of(answer, "log"):
            break
        ((message,),) = of(answer, "log")
        assert len(cells) == 10
        assert f"lacks {36 - len(held) - 10} cells of the area" in message
        held += cells
        assert set(held) == set(nearest(divided_map, 5, 7, len(held)))
    assert len(held) == 30
    assert sorted(held + cells) == sorted(divided_map.corners)
    change(one, divided_map, "0_0.pcd", seed=3)
    answer = node.ask("update", 5, 7, 500)
    assert names(answer, "cell") == names(answer, "remove") == ["0_0.pcd"]
    # not one fits: what the node has stays
    node.ask("loader", one.endpoint, 60, 30, 5000)
    divided_map.change("20_0.pcd", seed=3)
    change(one, divided_map, "0_0.pcd", seed=4)
    logged, nothing = node.ask("update", 5, 7, 500)
    assert "lacks 2 cells" in logged[1]
    assert nothing == ["nullptr"]


def nearest(made: DividedMap, x: float, y: float, count: int) -> list[str]:
    """Names of the cells nearest to a place; the map's places are chosen so that no two are as near."""

    def distance(name: str) -> float:
        x0, y0, x1, y1 = made.box(name)
        return math.hypot(max(x0 - x, x - x1, 0), max(y0 - y, y - y1, 0))

    return sorted(made.corners, key=distance)[:count]


def test_more_voxels_than_an_answer_can_have(
    daemon: DaemonFactory, node: AutowareNode, tmp_path: Path
) -> None:
    """A layer has versions of its own: cells that the node holds are looked at, and do not come again."""
    one = daemon(make_map(tmp_path / "map", points=8000).root)
    warm(one)
    node.ask("loader", one.endpoint, 60, 30, 500_000)
    rounds, held = 0, 0
    while of(answer := node.ask("grids", 5, 7, 500), "log"):
        assert 0 < len(of(answer, "grid")) < 36
        assert of(answer, "remove") == []
        rounds, held = rounds + 1, held + len(of(answer, "grid"))
    assert rounds > 1
    assert held + len(of(answer, "grid")) == 36
    with shmmap.connect(one.endpoint) as python:
        cells = python.around(0, 0, radius=500, layers=["ndt(leaf=2.0)"]).raise_for_failures()
        assert node.ask("leaves") == [leaves_of(cell) for cell in cells]


def test_more_ids_than_a_request_can_name(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap
) -> None:
    """A daemon takes 4 MiB: cells are found without it, and unknown ids removed."""
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 30)
    first = of(node.ask("update", 5, 5, 30), "cell")
    unknown = [f"/nowhere/{'x' * 100}/{number}.pcd@{number + 1:016x}" for number in range(40_000)]
    held = [line[0] for line in first[:10]]
    answer = node.ask("ask", 5, 5, 30, ";".join(unknown + held))
    assert of(answer, "cell") == first[10:]
    assert [line[0] for line in of(answer, "remove")] == unknown


def test_a_service_answers(daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap) -> None:
    """Whatever is missing; only without a daemon there is no answer."""
    (divided_map.pcd_dir / "0_0.pcd").write_bytes((divided_map.pcd_dir / "0_0.pcd").read_bytes()[:300])
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 0.3, 30)
    warm(one)
    held = ";".join(line[0] for line in of(node.ask("update", *EVERYTHING), "cell"))
    assert [line[0] for line in node.ask("ask", *EVERYTHING, held)] == ["log", "nullptr"]
    assert [line[0] for line in node.ask("service", *EVERYTHING, held)] == ["log", "header"]
    assert [line[0] for line in node.ask("service", 0, 0, 0, held)][:3] == ["log", "header", "remove"]
    one.stop()
    assert [line[0] for line in node.ask("service", *EVERYTHING, held)] == ["log", "nullptr"]


def test_a_node_that_restarts_receives_everything(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 5)
    first = node.ask("update", *EVERYTHING)
    node.ask("forget")
    assert node.ask("update", *EVERYTHING) == first
    assert len(of(first, "cell")) == 36


@pytest.mark.parametrize("kill", [False, True])
def test_a_daemon_that_restarts(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap, *, kill: bool
) -> None:
    """Versions are the same after its restart: only what has changed comes, and what is gone is removed."""
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 30)
    node.ask("update", *EVERYTHING)
    if kill:
        one.kill()
    else:
        one.stop()
    one.start()
    assert node.ask("update", *EVERYTHING) == [["header", "map", "0", "0"]]
    one.stop()
    divided_map.change("0_0.pcd", seed=3)
    divided_map.remove_cell("20_20.pcd")
    divided_map.write_cell("80_80.pcd", (80, 80), divided_map.points("40_40.pcd"))
    divided_map.write_metadata()
    one.start()
    answer = node.ask("update", *EVERYTHING)
    assert names(answer, "cell") == ["0_0.pcd", "80_80.pcd"]
    assert names(answer, "remove") == ["0_0.pcd", "20_20.pcd"]


def warm(one: DaemonProcess) -> None:
    """Have all cells in memory."""
    with shmmap.connect(one.endpoint) as python:
        python.around(0, 0, radius=500, layers=["points", "ndt(leaf=2.0)"], wait=60)


def test_without_a_daemon(daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap) -> None:
    """It is nullptr and a message, at the start as later; the node keeps what it holds."""
    one = daemon(divided_map.root)
    one.stop()
    node.ask("loader", one.endpoint, 0.2, 5)
    for command, nothing in (("update", "nullptr"), ("grids", "nothing")):
        logged, answer = node.ask(command, *EVERYTHING)
        assert logged[0] == "log"
        assert one.endpoint in logged[1]
        assert answer == [nothing]
    one.start()
    warm(one)
    assert len(of(node.ask("update", *EVERYTHING), "cell")) == 36
    one.stop()
    logged, answer = node.ask("update", *EVERYTHING)
    assert (logged[0], answer) == ("log", ["nullptr"])
    divided_map.change("0_0.pcd", seed=3)
    one.start()
    warm(one)
    assert names(node.ask("update", *EVERYTHING), "cell") == ["0_0.pcd"]


def test_a_daemon_that_hangs(daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    stop(one.pid)
    node.ask("loader", one.endpoint, 0.2, 0.2)
    logged, answer = node.ask("update", *EVERYTHING)
    assert logged[0] == "log"
    assert "does not answer" in logged[1]
    assert answer == ["nullptr"]
    one.send(signal.SIGCONT)
    node.ask("loader", one.endpoint, 60, 30)
    assert len(of(node.ask("update", *EVERYTHING), "cell")) == 36


def test_what_is_refused(daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 5)
    (logged, nothing) = node.ask("update", 0, 0, -1)
    assert (logged[0], nothing) == ("log", ["nullptr"])
    (logged, nothing) = node.ask("update", "nan", 0, 10)
    assert (logged[0], nothing) == ("log", ["nullptr"])
    assert len(of(node.ask("update", *EVERYTHING), "cell")) == 36


def test_cells_that_are_damaged(daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap) -> None:
    """One costs no other; where nothing else is new, nothing could be fetched."""
    good = (divided_map.pcd_dir / "0_0.pcd").read_bytes()
    for name in ("0_0.pcd", "20_20.pcd"):
        (divided_map.pcd_dir / name).write_bytes(good[:300])
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 5)
    answer = node.ask("update", *EVERYTHING)
    (((message,),), cells) = of(answer, "log"), of(answer, "cell")
    assert len(cells) == 34
    assert "0_0.pcd" in message
    assert "load_failed" in message
    assert message.endswith("cells missing in all: 2")
    assert [line[0] for line in node.ask("update", *EVERYTHING)] == ["log", "nullptr"]
    (divided_map.pcd_dir / "20_20.pcd").write_bytes(data_as(divided_map, "20_20.pcd"))
    with shmmap.connect(one.endpoint) as python:
        python.reload()
    answer = node.ask("update", *EVERYTHING)
    assert names(answer, "cell") == ["20_20.pcd"]
    assert of(answer, "log")


def data_as(made: DividedMap, name: str) -> bytes:
    """A good file for a cell that was damaged."""
    made.change(name, seed=5)
    return (made.pcd_dir / name).read_bytes()


def test_what_is_not_loaded_in_time(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root, "--workers", "1")
    with shmmap.connect(one.endpoint) as python:
        python.around(0, 0, radius=5)
    (loader,) = one.stop_loaders()
    node.ask("loader", one.endpoint, 0.3, 30)
    answer = node.ask("update", 0, 0, 15)
    assert len(of(answer, "cell")) == 4
    assert of(answer, "log") == []
    answer = node.ask("update", 20, 0, 15)  # two are new, two are known
    ((message,),) = of(answer, "log")
    assert "it is still being loaded" in message
    assert answer[-1] == ["nullptr"]
    (others,) = node.ask("update", 0, 0, 5)  # it holds what it held
    assert others[0] == "header"
    # names of what is still being loaded stay: plain ids as well as old versions
    loading = divided_map.id("20_0.pcd")
    answer = node.ask("service", 20, 0, 15, loading)
    assert (len(of(answer, "cell")), of(answer, "remove")) == (2, [])
    held = node.ask("held")
    change(one, divided_map, "0_0.pcd", seed=7)
    answer = node.ask("service", 0, 0, 15, ";".join(line[0] for line in held))
    assert [line[0] for line in answer] == ["log", "header"]
    os.kill(loader, signal.SIGCONT)
    warm(one)
    answer = node.ask("update", 20, 0, 15)
    assert (len(of(answer, "cell")), len(of(answer, "remove"))) == (3, 3)


def test_an_area_larger_than_the_daemon_s_memory(
    daemon: DaemonFactory, node: AutowareNode, tmp_path: Path
) -> None:
    """Cells are released as they are copied: there is room for the next ones."""
    made = make_map(tmp_path / "map", points=20_000)
    one = daemon(made.root, "--budget", "6M")
    node.ask("loader", one.endpoint, 60, 5)
    answer = node.ask("update", *EVERYTHING)
    assert of(answer, "log") == []
    assert len(of(answer, "cell")) == 36
    for line in of(answer, "cell"):
        assert line[4] == crc_of(Path(plain(line[0])))


def leaves_of(cell: shmmap.Cell) -> list[str]:
    """What the node prints of a cell's leaves."""
    record = np.zeros(
        len(cell["count"]),
        [("nr_points", "<i4"), ("mean", "<f8", 3), ("centroid", "<f4", 4), ("icov", "<f8", (3, 3))],
    )
    record["nr_points"] = cell["count"]
    record["mean"] = cell["mean"]
    record["centroid"][:, :3] = cell["mean"]
    record["icov"] = cell["inverse_covariance"][:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    return [f"{cell.id}@{cell.version:016x}", str(len(record)), str(zlib.crc32(record.tobytes()))]


def test_leaves_are_those_of_the_layer(
    daemon: DaemonFactory, node: AutowareNode, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    node.ask("loader", one.endpoint, 60, 5)
    answer = node.ask("grids", 0, 0, 15)
    assert len(of(answer, "grid")) == 4
    answer = node.ask("grids", 20, 0, 15)
    assert (len(of(answer, "grid")), len(of(answer, "remove"))) == (2, 2)
    divided_map.change("0_0.pcd", seed=9, count=3000)
    with shmmap.connect(one.endpoint) as python:
        python.reload()
        answer = node.ask("grids", *EVERYTHING)
        assert len(of(answer, "grid")) == 36 - 4 + 1
        assert "0_0.pcd" in names(answer, "grid")
        cells = python.around(0, 0, radius=500, layers=["ndt(leaf=2.0)"], wait=60).raise_for_failures()
        assert node.ask("leaves") == [leaves_of(cell) for cell in cells]
    assert names(node.ask("grids", 0, 0, 0), "remove") == sorted(
        set(divided_map.corners) - set(divided_map.in_square(0, 0, 0))
    )


def test_a_voxel_without_an_inverse(node: AutowareNode) -> None:
    """Autoware keeps it, with -1 points; coordinates count from the cell's origin."""
    assert node.ask("refused") == [
        ["7 1001 2 3 1001 2 3 0 1 2 3 2 4 5 3 5 6"],
        ["-1 1004 5 6 1004 5 6 0 0 0 0 0 0 0 0 0 0"],
    ]
    assert node.ask("crooked") == [["segment_corrupt"]]


@pytest.mark.parametrize(
    ("compiler", "standard"), [("g++", "c++20"), ("clang++", "c++17"), ("clang++", "c++20")]
)
def test_other_compilers(compiler: str, standard: str) -> None:
    """They find nothing to warn of, either."""
    programs_or_skip(compiler)
    subprocess.run([compiler, f"-std={standard}", "-fsyntax-only", *FLAGS, str(NODE)], check=True)
