# SPDX-License-Identifier: Apache-2.0
"""The client in C++ beside the one in Python: the same cells, the same bytes, the same errors."""

from __future__ import annotations

import os
import shutil
import zlib
from pathlib import Path

import msgspec
import numpy as np
import pytest

import shmmap
from tests.cpp.conftest import DaemonFactory
from tests.support.cpp_client import CppClient, compiled
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.patience import Patience

LAYERS = ("points", "voxel(leaf=1.0)", "ndt(leaf=2.0)", "elevation(resolution=1.0)", "ground(resolution=1.0)")
EVERYTHING = (0.0, 0.0, 500.0)


def columns(cells: shmmap.CellSet) -> list[list[str]]:
    """What the client in C++ prints of these."""
    found = []
    for cell in sorted(cells, key=lambda one: (one.id.encode(), one.layer.encode())):
        for name in cell.columns:
            values = cell[name]
            shape = "".join(f"{side} " for side in values.shape)
            crc = zlib.crc32(np.ascontiguousarray(values).tobytes())
            found.append([cell.id, cell.layer, name, values.dtype.str, shape, cell.unit(name), str(crc)])
    return found


def names(answer: list[list[str]], kind: str) -> list[str]:
    """The first word after this one in all such lines."""
    return [line[1] for line in answer if line[0] == kind]


def test_every_column_has_the_same_bytes(
    daemon: DaemonFactory, client: CppClient, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client.ask("connect", one.endpoint)
    answer = client.ask("area", *EVERYTHING, ";".join(LAYERS), 60.0)
    with shmmap.connect(one.endpoint) as python:
        cells = python.around(0.0, 0.0, radius=500.0, layers=LAYERS, wait=60.0).raise_for_failures()
        assert names(answer, "cell") == [cell.id for cell in cells]
        assert client.ask("columns") == columns(cells)


def test_real_maps_too(daemon: DaemonFactory, client: CppClient, data_dir: Path) -> None:
    one = daemon(data_dir / "kitti0005_map" / "map_static_v005.pcd")
    client.ask("connect", one.endpoint)
    client.ask("area", 0.0, 0.0, 1e6, "points;ndt(leaf=2.0)", 120.0)
    with shmmap.connect(one.endpoint) as python:
        cells = python.around(0.0, 0.0, radius=1e6, layers=("points", "ndt(leaf=2.0)"), wait=120.0)
        assert sum(len(cell.xyz) for cell in cells.raise_for_failures() if cell.layer == "points") > 1e6
        assert client.ask("columns") == columns(cells)


def test_only_what_it_has_not_comes_again(
    daemon: DaemonFactory, client: CppClient, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client.ask("connect", one.endpoint)
    first = client.ask("area", 0.0, 0.0, 15.0, "points", 30.0)
    there = set(names(first, "cell"))
    further = client.ask("differential", 0.0, 0.0, 35.0, "points", 30.0)
    assert there.isdisjoint(names(further, "cell"))
    assert names(further, "cell")
    elsewhere = client.ask("differential", 1000.0, 1000.0, 1.0, "points", 30.0)
    assert len(names(elsewhere, "removed_version")) == len(there) + len(names(further, "cell"))
    assert client.ask("columns") == []


def test_what_it_lets_go_can_be_freed(
    daemon: DaemonFactory, client: CppClient, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    client.ask("connect", one.endpoint)
    client.ask("area", *EVERYTHING, "points", 30.0)
    with shmmap.connect(one.endpoint) as python:
        (session,) = (it for it in python.stats().sessions if it.client == "cpp")
        assert session.cells == 36
        client.ask("drop")
        python.evict()
        waiting = Patience()
        while waiting(bool(python.stats().counters["zombies"])):
            pass


def test_a_map_that_changes(daemon: DaemonFactory, client: CppClient, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client.ask("connect", one.endpoint)
    before = client.ask("area", *EVERYTHING, "points", 30.0)
    changed = sorted(divided_map.root.glob("**/*.pcd/*.pcd"))[0]
    os.utime(changed)
    with shmmap.connect(one.endpoint) as python:
        python.reload()
    after = client.ask("differential", *EVERYTHING, "points", 30.0)
    assert [Path(name).name for name in names(after, "cell")] == [changed.name]
    assert names(after, "removed_version") == []
    versions = {line[1]: line[3] for line in before if line[0] == "cell"}
    assert [versions[line[1]] == line[3] for line in after if line[0] == "cell"] == [False]


@pytest.mark.parametrize("kill", [False, True])
def test_a_daemon_that_begins_anew(
    daemon: DaemonFactory, client: CppClient, divided_map: DividedMap, *, kill: bool
) -> None:
    """What is mapped stays, and the next request goes to the new life."""
    one = daemon(divided_map.root)
    ((_, _, epoch),) = client.ask("connect", one.endpoint)
    client.ask("area", *EVERYTHING, "points", 30.0)
    there = client.ask("columns")
    if kill:
        one.kill()
    else:
        one.stop()
    assert client.ask("columns") == there
    one.start()
    answer = client.ask("area", *EVERYTHING, "points", 30.0)
    assert client.ask("columns") == there
    assert answer[-1][1] != epoch


def test_errors_have_their_codes(daemon: DaemonFactory, client: CppClient, divided_map: DividedMap) -> None:
    ((kind, code, message),) = client.ask("connect", "/nowhere/shmmap.sock")
    assert (kind, code) == ("error", "no_socket")
    assert "/nowhere/shmmap.sock" in message
    ((_, code, _),) = client.ask("connect", "/" + "x" * 200)
    assert code == "no_socket"
    one = daemon(divided_map.root)
    client.ask("connect", one.endpoint)
    ((_, code, _),) = client.ask("area", 0.0, 0.0, -1.0, "points", 1.0)
    assert code == "bad_request"
    ((_, code, _),) = client.ask("area", *EVERYTHING, "no such layer", 1.0)
    assert code == "bad_request"
    failed = next(line for line in client.ask("selected", "nobody.pcd", "points", 1.0) if line[0] == "failed")
    assert failed[1:4] == ["nobody.pcd", "points", "unknown_cell"]
    assert len(names(client.ask("area", *EVERYTHING, "points", 30.0), "cell")) == 36


def test_a_header_of_which_any_byte_was_changed(
    daemon: DaemonFactory, client: CppClient, divided_map: DividedMap
) -> None:
    """It is refused, or the columns are the same: nothing is read that is not there."""
    one = daemon(divided_map.root)
    client.ask("connect", one.endpoint)
    cell = sorted(path.name for path in divided_map.root.glob("**/*.pcd/*.pcd"))[0]
    assert names(client.ask("selected", cell, "points", 30.0), "cell")
    right = client.ask("columns")
    (path,) = _segments(one)
    unchecked = 0
    with open(path, "r+b", buffering=0) as file:
        for at in range(4096):
            client.ask("drop")
            was = os.pread(file.fileno(), 1, at)
            os.pwrite(file.fileno(), bytes([was[0] ^ (1 + at % 255)]), at)
            answer = client.ask("selected", cell, "points", 30.0)
            if names(answer, "cell"):
                unchecked += 1
                assert client.ask("columns") == right
                assert at >= 4096 - 72, "the checksum covers the rest"
            else:
                assert [line[3] for line in answer if line[0] == "failed"] == ["load_failed"]
            os.pwrite(file.fileno(), was, at)
    assert unchecked == 68, "the publish block and what fills up"


def _segments(one: DaemonProcess) -> list[str]:
    start = f"shmmap.{one.instance}."
    found = [name for name in os.listdir(one.shm_dir) if name.startswith(start)]
    return [f"{one.shm_dir}/{name}" for name in found if "statistics" not in name]


def test_messages_that_are_wrong(client: CppClient) -> None:
    """Cut, changed, longer: each is read or refused, and no byte beyond it."""
    handle = ["-20_20.pcd", 2**63, "points", f"{7:016x}", 0, 8192, 500, -20.0, 20.0, 0.0, 40.0, False]
    failed = ["c.pcd", "points", "over_budget", "no", [[1, 2, 3, "x", 5]]]
    later = {"unknown": [1.5, None]}
    reply = [
        "cells", 3, 5, 7, [handle] * 3, ["a.pcd"], bytes(range(8)), [["b.pcd", "points"]], [failed],
        ["points"], True, later,
    ]  # fmt: skip
    packed = msgspec.msgpack.encode(reply)
    ((_, read),) = client.ask("fuzz", 1, 100_000, packed.hex())
    assert 0 < int(read) < 100_000


@pytest.mark.parametrize(
    ("compiler", "standard"), [("g++", "c++20"), ("clang++", "c++17"), ("clang++", "c++20")]
)
def test_other_compilers(tmp_path: Path, compiler: str, standard: str) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is missing")
    assert CppClient(compiled(tmp_path, compiler=compiler, standard=standard)).close() == 0
