# SPDX-License-Identifier: Apache-2.0
"""The client in C++ beside the one in Python: the same bytes, whatever is damaged, and no byte beyond them.

What both clients do alike is tested with both in ``tests/process``.
"""

from __future__ import annotations

import os
import subprocess
import zlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import shmmap
from tests.cpp.conftest import DaemonFactory
from tests.support.cpp_client import FLAGS, SOURCE, CppClient, CppProgram, compiled
from tests.support.daemon_process import Deadline
from tests.support.divided_map import DividedMap
from tests.support.skips import open3d_or_skip, programs_or_skip

LAYERS = (
    "points",
    "crop(z_min=-1.0, z_max=3.0)",
    "denoise(neighbors=10)",
    "elevation(resolution=1.0)",
    "ground(resolution=1.0)",
    "ndt(leaf=2.0)",
    "normals(radius=1.0)",
    "sample(count=100)",
    "search(leaf=1.0)",
    "voxel(leaf=1.0)",
)
QUICK_LAYERS = tuple(layer for layer in LAYERS if not layer.startswith(("denoise", "normals")))
MUTATIONS = int(os.environ.get("SHMMAP_TEST_MUTATIONS", "50000"))
"""Mutated messages of each kind; a million takes some minutes."""


def columns(cells: shmmap.CellSet) -> list[list[str]]:
    """What the client in C++ prints of these."""
    found = []
    for cell in sorted(cells, key=lambda one: (one.id.encode(), one.layer.encode())):
        for name in cell.columns:
            values = cell[name]
            shape = "".join(f"{side} " for side in values.shape)
            crc = zlib.crc32(np.ascontiguousarray(values).tobytes())
            found.append([cell.id, cell.layer, name, values.dtype.str, shape, cell.unit(name), str(crc)])
        if cell.lattice is not None:
            leaf, first, sides = cell.lattice
            axes = [f"{leaf[axis]:.17g} {first[axis]} {sides[axis]}" for axis in range(3)]
            found.append([cell.id, cell.layer, "lattice", *axes])
    return found


def equal_bytes(program: Path, endpoint: str, layers: tuple[str, ...]) -> int:
    """Compare every column of every cell in these layers; returns the number of points."""
    with (
        shmmap.connect(endpoint, timeout=600.0) as python,
        CppClient(program, endpoint, timeout=600.0) as client,
    ):
        everything = shmmap.Circle(0.0, 0.0, 1e6)
        cells = python.area(everything, layers, wait=600.0).raise_for_failures()
        answer = client.area(everything, layers, wait=600.0).raise_for_failures()
        assert [(cell.id, cell.layer, cell.version) for cell in answer] == [
            (cell.id, cell.layer, cell.version) for cell in cells
        ]
        assert client.columns() == columns(cells)
        return sum(len(cell.xyz) for cell in cells if cell.layer == "points")


def test_every_column_has_the_same_bytes(
    daemon: DaemonFactory, cpp_program: Path, divided_map: DividedMap
) -> None:
    open3d_or_skip()
    assert equal_bytes(cpp_program, daemon(divided_map.root).endpoint, LAYERS) == 36 * 500


def test_real_maps_too(daemon: DaemonFactory, cpp_program: Path, data_dir: Path) -> None:
    """``SHMMAP_TEST_EVERY_LAYER=1`` has those, too, that take minutes to compute."""
    one = daemon(data_dir / "kitti0005_map" / "map_static_v005.pcd")
    layers = LAYERS if "SHMMAP_TEST_EVERY_LAYER" in os.environ else QUICK_LAYERS
    assert equal_bytes(cpp_program, one.endpoint, layers) > 1e6


def test_what_it_releases_can_be_freed(
    daemon: DaemonFactory, cpp_program: Path, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as python, CppClient(cpp_program, one.endpoint) as client:
        held: Any = client.around(0, 0, 500, wait=30.0).raise_for_failures()
        (session,) = (it for it in python.stats().sessions if it.client == "cpp")
        assert session.cells == len(held) == 36
        del held
        client.release()
        (session,) = (it for it in python.stats().sessions if it.client == "cpp")
        assert session.cells == 0
        python.evict()
        waiting = Deadline()
        while waiting(bool(python.stats().counters["zombies"])):
            pass


def test_a_hoarder_meets_its_quota_and_others_get_theirs(
    daemon: DaemonFactory, cpp_program: Path, divided_map: DividedMap
) -> None:
    """Each cell is reported so, and the client keeps what it has."""
    one = daemon(divided_map.root, "--budget", "1M", "--session-quota", "0.5")
    with CppClient(cpp_program, one.endpoint) as hoarder, CppClient(cpp_program, one.endpoint) as modest:
        held: Any = hoarder.around(0, 0, 500, wait=10.0)
        assert {failure.code for failure in held.failed} == {"over_budget"}
        assert 0 < len(held) < 36
        assert len(held) + len(held.failed) == 36
        for x in (-50.0, 0.0, 50.0):
            assert modest.around(x, 50.0, 5.0, wait=20.0).complete
        del held


def test_errors_say_where_no_daemon_answers(cpp_program: Path) -> None:
    with pytest.raises(shmmap.errors.NoSocket, match=r"/nowhere/shmmap\.sock"):
        CppClient(cpp_program, "/nowhere/shmmap.sock")
    with pytest.raises(shmmap.errors.NoSocket, match="107 bytes"):
        CppClient(cpp_program, "/" + "x" * 200)


def test_requests_that_make_no_sense_cost_nothing_else(
    daemon: DaemonFactory, cpp_program: Path, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    with CppClient(cpp_program, one.endpoint) as client:
        with pytest.raises(shmmap.BadRequest):
            client.program.call("area", "circle 0 0 -1", "points", 1.0)
        with pytest.raises(shmmap.BadRequest):
            client.around(0, 0, 10, "no such layer")
        with pytest.raises(shmmap.errors.NoColumn, match=r"no column no such .there are: xyz, intensity"):
            client.around(0, 0, 10, wait=30.0)[0]["no such"]
        assert client.around(0, 0, 500, wait=30.0).complete


def test_a_header_of_which_any_byte_was_changed(
    daemon: DaemonFactory, cpp_program: Path, divided_map: DividedMap
) -> None:
    """It is refused, or the columns are the same: nothing is read that is not there."""
    one = daemon(divided_map.root)
    name = sorted(divided_map.corners)[0]
    with CppClient(cpp_program, one.endpoint) as client:
        cells: Any = client.selected(name, wait=30.0)
        assert cells.complete
        right = client.columns()
        (path,) = (f"{one.shm_dir}/{segment}" for segment in one.segments())
        unchecked = 0
        os.chmod(path, 0o600)  # or its owner may not write either
        with open(path, "r+b", buffering=0) as file:
            for at in range(4096):
                del cells
                was = os.pread(file.fileno(), 1, at)
                os.pwrite(file.fileno(), bytes([was[0] ^ (1 + at % 255)]), at)
                cells = client.selected(name, wait=30.0)
                if len(cells):
                    unchecked += 1
                    assert client.columns() == right
                    assert at >= 4096 - 72, "the checksum covers the rest"
                else:
                    assert [failure.code for failure in cells.failed] == ["load_failed"]
                os.pwrite(file.fileno(), was, at)
        assert unchecked == 68, "the publish block and what fills up"
        del cells


def test_messages_that_are_wrong(program: CppProgram) -> None:
    """Cut, changed, longer: each is read or refused, and no byte beyond it."""
    handle = ["-20_20.pcd", 2**63, "points", f"{7:016x}", 0, 8192, 500, -20.0, 20.0, 0.0, 40.0, False]
    later = {"unknown": [1.5, None]}
    box = [-20.0, 20.0, 0.0, 40.0]
    failed = [
        ["c.pcd", "points", "over_budget", "no", [[1, 2, 3, "x", 5]], box, later],
        ["d.pcd", "points", "unknown_cell", "no", [], None],
        ["e.pcd", "points", "offline", "no"],
    ]
    reply = [
        "cells",
        3,
        5,
        7,
        [handle] * 3,
        ["a.pcd"],
        bytes(range(8)),
        [["b.pcd", "points"]],
        failed,
        ["points"],
        False,
        "offline",
        later,
    ]
    row = ["-20_20.pcd", 2**63, -20.0, 20.0, 0.0, 40.0, 8192, -1.0, None]
    page = ["metadata_page", 3, 5, 7, [row] * 3, 3, True, ["a.pcd"], later]
    event = ["loaded", 17, 2**63, 10**18, "a.pcd", "points", 2**63, 8192, 500, 10**6, False, 0, later]
    for message in (reply, page, event):
        ((_, read),) = program.ask("fuzz", 1, MUTATIONS, msgspec.msgpack.encode(message).hex())
        assert 0 < int(read) < MUTATIONS


@pytest.mark.parametrize(("compiler", "standard"), [("g++", "c++20"), ("clang++", "c++17")])
def test_other_compilers(compiler: str, standard: str) -> None:
    """They find nothing to warn of, either."""
    programs_or_skip(compiler)
    subprocess.run([compiler, f"-std={standard}", "-fsyntax-only", *FLAGS, str(SOURCE)], check=True)


def test_by_another_compiler_and_standard(
    tmp_path: Path, daemon: DaemonFactory, divided_map: DividedMap
) -> None:
    programs_or_skip("clang++")
    program = compiled(tmp_path, compiler="clang++", standard="c++20", optimize="-O0")
    assert equal_bytes(program, daemon(divided_map.root).endpoint, QUICK_LAYERS) == 36 * 500


def test_a_request_too_large_is_refused_before_it_is_sent(
    daemon: DaemonFactory, cpp_program: Path, divided_map: DividedMap
) -> None:
    """A daemon would end the connection; what comes next is answered."""
    one = daemon(divided_map.root)
    with CppClient(cpp_program, one.endpoint) as client:
        session = client.program.ask("area", "circle 0 0 1", "points", "5")
        with pytest.raises(shmmap.BadRequest, match="4 MiB"):
            client.selected(["x" * (5 << 20)])
        assert client.program.ask("area", "circle 0 0 1", "points", "5") == session
