# SPDX-License-Identifier: Apache-2.0
"""Every odd or bad file as a cell of a served map: its own outcome, and no harm to anybody else."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.process_costs import peak_bytes
from tests.support.raw_client import RawClient, circle
from tests.support.segment_reader import read_segment

Connect = Callable[..., RawClient]


def serve(
    daemon: DaemonFactory, connect: Connect, made: DividedMap, files: dict[str, bytes]
) -> tuple[DaemonProcess, RawClient]:
    """Serve a map whose cells beyond x = 1000 m are these files."""
    for number, (name, content) in enumerate(files.items()):
        (made.pcd_dir / name).write_bytes(content)
        made.corners[name] = (1000 + 20 * number, 0)
    made.write_metadata()
    one = daemon(made.root, "--workers", "1")
    return one, connect(one)


def assert_outcomes(
    one: DaemonProcess, client: RawClient, made: DividedMap, expected: dict[str, int | None], largest: int
) -> None:
    """Ask for each cell alone, then all at once; None stands for a refusal, else points in the file."""
    client.area(circle(0, 0, 5))
    (loader,) = one.loaders()
    idle = peak_bytes(loader)
    for name, points in expected.items():
        reply = client.selected([name])
        if points is None:
            assert [(f.id, f.code) for f in reply.failed] == [(name, "load_failed")], name
            assert made.id(name) in reply.failed[0].message
            assert reply.cells == []
        else:
            assert reply.failed == [], name
            (handle,) = reply.cells
            segment = read_segment(client.path(handle))
            assert segment.fields["source_points"] == points, name
            assert handle.points == points - segment.fields["dropped_points"]
            assert np.isfinite(segment.columns["xyz"]).all()
    assert one.loaders() == [loader]  # none of them cost a loader its life
    assert peak_bytes(loader) - idle < (100 << 20) + largest
    everything = client.area(circle(0, 0, 1e5))
    assert {f.id.rsplit("/", 1)[-1] for f in everything.failed} == {
        n for n, p in expected.items() if p is None
    }
    assert len(everything.cells) + len(everything.failed) == len(made.corners)
    assert len(client.area(circle(0, 0, 5)).cells) == 4


def test_the_collected_files(daemon: DaemonFactory, connect: Connect, tmp_path: Path, data_dir: Path) -> None:
    made = make_map(tmp_path / "map", columns=2, rows=2)
    outcomes = json.loads((data_dir / "pcd_edge" / "expected.json").read_text())
    files = {f"{name}.pcd": (data_dir / "pcd_edge" / f"{name}.pcd").read_bytes() for name in outcomes}
    one, client = serve(daemon, connect, made, files)
    expected = {
        f"{name}.pcd": None if outcome["expect"] == "error" else outcome["points"]
        for name, outcome in outcomes.items()
    }
    assert len(expected) == 65
    assert_outcomes(one, client, made, expected, max(map(len, files.values())))


def header(
    encoding: str, points: object = 3, *, fields: str = "x y z", size: str = "4 4 4", type_: str = "F F F"
) -> bytes:
    return (
        f"VERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {type_}\nCOUNT {'1 ' * len(fields.split())}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {encoding}\n"
    ).encode()


def compressed(packed: bytes, plain: int, size: int | None = None) -> bytes:
    return struct.pack("<II", len(packed) if size is None else size, plain) + packed


def test_files_made_here(daemon: DaemonFactory, connect: Connect, tmp_path: Path) -> None:
    """The kinds of damage there are, without any collection of files."""
    made = make_map(tmp_path / "map", columns=2, rows=2)
    body = np.arange(9, dtype="<f4").tobytes()
    literal = bytes([31]) + bytes(32) + bytes([3]) + bytes(4)  # 36 zero bytes as LZF literals
    odd = np.array([[1, 2, 3], [np.nan, 0, 0], [4, np.inf, 6]], "<f4").tobytes()
    cases: dict[str, tuple[bytes, int | None]] = {
        "good": (header("binary") + body, 3),
        "good ascii": (header("ascii") + b"1 2 3\n4 5 6\n7 8 9\n", 3),
        "good compressed": (header("binary_compressed") + compressed(literal, 36), 3),
        "not finite": (header("binary") + odd, 3),
        "no points": (header("binary", 0), 0),
        "carriage returns": ((header("ascii") + b"1 2 3\n4 5 6\n7 8 9\n").replace(b"\n", b"\r\n"), 3),
        "empty": (b"", None),
        "zeros": (bytes(8192), None),
        "noise": (np.random.default_rng(3).bytes(5000), None),
        "pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n", None),
        "header only": (header("binary"), None),
        "header cut": (header("binary")[:60], None),
        "body cut": (header("binary") + body[:-1], None),
        "rows missing": (header("ascii") + b"1 2 3\n4 5 6\n", None),
        "row short": (header("ascii") + b"1 2 3\n4 5\n7 8 9\n", None),
        "no number": (header("ascii") + b"1 2 3\n4 five 6\n7 8 9\n", None),
        "encoding": (header("quantum") + body, None),
        "negative": (header("binary", -3) + body, None),
        "huge": (header("binary", 2**40) + body, None),
        "larger than 64 bits": (header("binary", 2**70) + body, None),
        "no number of points": (header("binary", "many") + body, None),
        "no z": (header("binary", 3, fields="x y w") + body, None),
        "size": (header("binary", 3, size="4 4 3") + body, None),
        "type": (header("binary", 3, type_="F F Q") + body, None),
        "compressed sizes cut": (header("binary_compressed") + b"\1\0\0", None),
        "compressed too long": (header("binary_compressed") + compressed(literal, 36, 4000), None),
        "compressed huge": (header("binary_compressed") + compressed(literal, 2**32 - 1), None),
        "compressed bomb": (header("binary_compressed", 10**8) + compressed(literal, 1_200_000_000), None),
        "compressed reference": (
            header("binary_compressed") + compressed(b"\xe0\xff\xff" + literal, 36),
            None,
        ),
    }
    files = {f"{name}.pcd": content for name, (content, _) in cases.items()}
    one, client = serve(daemon, connect, made, files)
    expected = {f"{name}.pcd": points for name, (_, points) in cases.items()}
    assert_outcomes(one, client, made, expected, max(map(len, files.values())))


@pytest.mark.parametrize("seed", range(3))
def test_mutated_files(daemon: DaemonFactory, connect: Connect, tmp_path: Path, seed: int) -> None:
    """Bytes changed, cut, repeated at random: a cell or a refusal, the daemon and its loader live."""
    made = make_map(tmp_path / "map", columns=2, rows=2)
    rng = np.random.default_rng(seed)
    shutil.copy(made.pcd_dir / "0_0.pcd", tmp_path / "seed.pcd")
    whole = (tmp_path / "seed.pcd").read_bytes()
    files = {}
    for number in range(30):
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, 6))):
            at = int(rng.integers(0, 260 if rng.random() < 0.8 else len(data)))
            kind = rng.integers(0, 3)
            if kind == 0:
                data[at : at + 1] = rng.bytes(1)
            elif kind == 1:
                del data[at : at + int(rng.integers(1, 40))]
            else:
                data[at:at] = data[at : at + int(rng.integers(1, 40))]
        files[f"mutated {number}.pcd"] = bytes(data)
    one, client = serve(daemon, connect, made, files)
    reply = client.area(circle(0, 0, 1e5))
    assert len(reply.cells) + len(reply.failed) == len(made.corners)
    assert {f.code for f in reply.failed} <= {"load_failed"}
    assert "loader replaced" not in one.log
    for handle in reply.cells:
        assert handle.points == len(read_segment(client.path(handle)).columns["xyz"])
    corner = (0, 0)
    made.write_cell("0_0.pcd", corner, random_points(rng, corner, 10))
    client.ask("reload")
    assert client.selected(["0_0.pcd"]).cells[0].points == 10


def test_names_that_no_client_could_say(daemon: DaemonFactory, connect: Connect, tmp_path: Path) -> None:
    """Neither the stray file that a reload reports nor the cell in an odd directory ends the daemon."""
    made = make_map(tmp_path / "map", columns=2, rows=2)
    cells = os.fsencode(made.pcd_dir)
    os.mkdir(cells + b"/\xff")
    os.rename(cells + b"/0_0.pcd", cells + b"/\xff/0_0.pcd")
    client = connect(daemon(made.root))
    assert len(client.area(circle(0, 0, 50)).cells) == 3
    with open(cells + b"/Stra\xdfe.pcd", "wb"):
        pass
    reloaded = client.ask("reload")
    assert reloaded[3:6] == [0, 0, 0]
    assert "Stra\\xdfe.pcd" in "\n".join(reloaded[6])
