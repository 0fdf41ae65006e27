# SPDX-License-Identifier: Apache-2.0
"""What is written reads back to the same bits, and stands on disk whole or not at all."""

from __future__ import annotations

import io
import os
import struct
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.formats.cloud import read_pcd
from shmmap.formats.pcd import writer as pcd_writer
from shmmap.formats.pcd.writer import write_pcd
from tests.support.cloud_bytes import lzf_decode

ENCODINGS = ("ascii", "binary", "binary_compressed")
TYPES = ["f4", "f8", "u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8"]
XYZ = np.array([[1, 2, 3], [4, 5, 6]], np.float32)


def columns(draw: st.DrawFn) -> dict[str, NDArray[Any]]:
    rows = draw(st.integers(0, 40))
    finite = {"allow_nan": False, "allow_infinity": False}
    found = {"xyz": draw(npst.arrays(draw(st.sampled_from(["f4", "f8"])), (rows, 3), elements=finite))}
    names = draw(st.lists(st.from_regex(r"[a-w][a-z0-9_]{0,20}", fullmatch=True), max_size=4, unique=True))
    for name in names:
        if name in ("xyz", "x", "y", "z"):
            continue
        count = draw(st.integers(1, 4))
        shape = (rows,) if count == 1 else (rows, count)
        kind = draw(st.sampled_from(TYPES))
        # a NaN's payload does not survive text, so NaN is left to the binary test below
        found[name] = draw(
            npst.arrays(kind, shape, elements={"allow_nan": False} if kind[0] == "f" else None)
        )
    return found


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(cloud=st.composite(columns)())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
def test_round_trip(tmp_path: Path, encoding: str, cloud: dict[str, NDArray[Any]]) -> None:
    path = tmp_path / "cloud.pcd"
    write_pcd(path, cloud, encoding=encoding)
    found = read_pcd(path)
    assert all("float32 and so far from zero" in warning for warning in found.warnings)
    assert (found.points, found.dropped) == (len(cloud["xyz"]), 0)
    assert set(found.columns) == set(cloud)
    for name, values in cloud.items():
        assert found.columns[name].dtype == values.dtype
        assert found.columns[name].shape == values.shape
        assert found.columns[name].tobytes() == values.tobytes()
    assert os.listdir(tmp_path) == ["cloud.pcd"]


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_nan_payloads_survive_in_binary(tmp_path: Path, encoding: str) -> None:
    bits = np.array([0x7F800001, 0xFFC12345], "<u4")
    write_pcd(tmp_path / "a.pcd", {"xyz": XYZ, "w": bits.view("<f4")}, encoding=encoding)
    assert read_pcd(tmp_path / "a.pcd").columns["w"].view("<u4").tolist() == bits.tolist()


def test_the_bytes_of_a_file() -> None:
    """The whole file, written down by hand."""
    file = io.BytesIO()
    cloud = {"label": np.array([7, 8], "u2"), "xyz": XYZ, "h": np.array([[1, 2], [3, 4]], "i1")}
    write_pcd(file, cloud, viewpoint=(0.5, 0, 0, 1, 0, 0, 0))
    assert file.getvalue() == (
        b"# .PCD v0.7 - Point Cloud Data file format\n"
        b"VERSION 0.7\nFIELDS label x y z h\nSIZE 2 4 4 4 1\nTYPE U F F F I\nCOUNT 1 1 1 1 2\n"
        b"WIDTH 2\nHEIGHT 1\nVIEWPOINT 0.5 0 0 1 0 0 0\nPOINTS 2\nDATA binary\n"
        + struct.pack("<Hfffbb", 7, 1, 2, 3, 1, 2)
        + struct.pack("<Hfffbb", 8, 4, 5, 6, 3, 4)
    )


def test_an_array_alone_is_xyz() -> None:
    file, same = io.BytesIO(), io.BytesIO()
    write_pcd(file, XYZ)
    write_pcd(same, {"xyz": XYZ})
    assert file.getvalue() == same.getvalue()
    with pytest.raises(BadRequest, match=r"\(N, 3\) is needed"):
        write_pcd(io.BytesIO(), XYZ[:, :2])


def test_the_bytes_of_a_compressed_body() -> None:
    file = io.BytesIO()
    write_pcd(file, {"xyz": XYZ, "h": np.array([[1, 2], [3, 4]], "i1")}, encoding="binary_compressed")
    body = file.getvalue().split(b"DATA binary_compressed\n")[1]
    compressed, plain = struct.unpack_from("<II", body)
    assert compressed == len(body) - 8
    assert lzf_decode(body[8:]) == struct.pack("<6f4b", 1, 4, 2, 5, 3, 6, 1, 2, 3, 4)
    assert plain == 28


def test_any_memory_layout_and_byte_order() -> None:
    base = np.arange(60, dtype=">f8").reshape(3, 20)
    cloud = {"xyz": base.T, "s": np.arange(40, dtype=">i4")[::2], "one": np.ones((20, 1), "f4")}
    for encoding in ENCODINGS:
        first, second = io.BytesIO(), io.BytesIO()
        write_pcd(first, cloud, encoding=encoding)
        plain = {
            "xyz": np.ascontiguousarray(base.T, "<f8"),
            "s": np.arange(0, 40, 2, dtype="<i4"),
            "one": np.ones(20, "f4"),
        }
        write_pcd(second, plain, encoding=encoding)
        assert first.getvalue() == second.getvalue()


@pytest.mark.parametrize(
    "cloud",
    [
        {},
        {"intensity": np.zeros(3, "f4")},
        {"x": np.zeros(3), "y": np.zeros(3)},
        {"xyz": np.zeros(3, "f4")},
        {"xyz": np.zeros((3, 4), "f4")},
        {"xyz": XYZ, "x": np.zeros(2)},
        {"xyz": XYZ, "i": np.zeros(3)},
        {"xyz": XYZ, "i": np.zeros((2, 2, 2))},
        {"xyz": XYZ, "i": np.zeros((2, 0))},
        {"xyz": XYZ, "i": np.zeros(2, "f2")},
        {"xyz": XYZ, "i": np.zeros(2, "?")},
        {"xyz": XYZ, "i": np.zeros(2, "c8")},
        {"xyz": XYZ, "_": np.zeros(2)},
        {"xyz": XYZ, "": np.zeros(2)},
        {"xyz": XYZ, "a b": np.zeros(2)},
        {"xyz": XYZ, "a\nb": np.zeros(2)},
    ],
)
def test_what_pcd_cannot_express(tmp_path: Path, cloud: dict[str, NDArray[Any]]) -> None:
    with pytest.raises(BadRequest):
        write_pcd(tmp_path / "a.pcd", cloud)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("viewpoint", [(0, 0, 0), (0, 0, 0, 1, 0, 0, float("nan"))])
def test_bad_viewpoints_and_encodings(viewpoint: tuple[float, ...]) -> None:
    with pytest.raises(BadRequest):
        write_pcd(io.BytesIO(), {"xyz": XYZ}, viewpoint=viewpoint)
    with pytest.raises(BadRequest):
        write_pcd(io.BytesIO(), {"xyz": XYZ}, encoding="binary_zstd")


def test_a_failure_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cloud.pcd"
    write_pcd(path, {"xyz": XYZ})
    before = path.read_bytes()
    whole = pcd_writer._write

    def half(file: IO[bytes], header: bytes, body: Any) -> None:
        whole(file, header, body)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pcd_writer, "_write", half)
    with pytest.raises(OSError, match="No space"):
        write_pcd(path, {"xyz": XYZ * 2})
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["cloud.pcd"]


def test_the_mode_follows_the_umask(tmp_path: Path) -> None:
    old = os.umask(0o027)
    try:
        write_pcd(tmp_path / "a.pcd", {"xyz": XYZ})
    finally:
        os.umask(old)
    assert (tmp_path / "a.pcd").stat().st_mode & 0o777 == 0o640
