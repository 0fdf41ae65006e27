# SPDX-License-Identifier: Apache-2.0
"""Bytes that are written by hand equal those of the serializer of `cyclonedds`, and say what they should."""

from __future__ import annotations

import json
import os
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="needs the package cyclonedds")

from shmmap_clients.ros_bridge import cdr
from shmmap_clients.ros_bridge.cdr import CdrWriter, Content, copy_into, write_cloud
from shmmap_clients.ros_bridge.messages import (
    DIFFERENTIAL,
    FREE,
    OCCUPIED,
    PARTIAL,
    SELECTED,
    CellMetaData,
    CellWithID,
    Damaged,
    Header,
    MapMetaData,
    PointCloud2,
    PointField,
    Time,
    VoxelGrid,
    ready_made,
)
from shmmap_clients.ros_bridge.parameters import PARAMETER_SERVICES, ParameterValue
from shmmap_clients.ros_bridge.type_hashes import HASHES, type_hash
from shmmap_clients.ros_cells import cloud_layout, fill_rows

from tests.support import type_hashes
from tests.support.ros.environment import environment_folder

TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
SETTINGS = settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
U32 = st.integers(0, 2**32 - 1)


def padded(data: bytes) -> bytes:
    return data.ljust(len(data) + -len(data) % 4, b"\0")


@st.composite
def clouds(draw: st.DrawFn) -> tuple[dict[str, Any], Any]:
    """Columns, and the message that they should be."""
    rows = draw(st.integers(0, 5))
    random = np.random.default_rng(draw(U32))
    columns: dict[str, Any] = {"xyz": random.normal(size=(rows, 3)).astype("<f4")}
    for name, kind in draw(
        st.dictionaries(st.sampled_from(["intensity", "ring", "t"]), st.sampled_from("fBHd"))
    ).items():
        columns[name] = random.integers(0, 200, rows).astype(kind)
    fields, record, offset = [], [], 0
    codes = {"f": 7, "B": 2, "H": 4, "d": 8}
    for name, values in columns.items():
        for one in "xyz" if name == "xyz" else (name,):
            fields.append(PointField(one, offset, codes[values.dtype.char], 1))
            record.append((one, values.dtype))
            offset += values.dtype.itemsize
    table = np.zeros(rows, record)
    for name, values in columns.items():
        if name == "xyz":
            table["x"], table["y"], table["z"] = values.T
        else:
            table[name] = values
    frame = draw(TEXTS)
    stamp = Time(draw(st.integers(0, 2**31 - 1)), draw(st.integers(0, 10**9 - 1)))
    data = list(table.tobytes())
    return columns, PointCloud2(
        Header(stamp, frame), 1, rows, fields, False, offset, offset * rows, data, True
    )


def write(writer: CdrWriter, columns: dict[str, Any], like: Any) -> None:
    stamp_ns = like.header.stamp.sec * 10**9 + like.header.stamp.nanosec
    write_cloud(writer, columns, (0.0, 0.0, 0.0), like.header.frame_id, stamp_ns)


@SETTINGS
@given(clouds())
def test_a_cloud_is_written_as_the_serializer_does(cloud: tuple[dict[str, Any], Any]) -> None:
    columns, message = cloud
    writer = CdrWriter()
    write(writer, columns, message)
    wanted = padded(message.serialize(use_version_2=False))
    assert bytes(writer.content()) == wanted
    for before in (0, 3, len(wanted), len(wanted) + 9):
        used = Content(b"\xaa" * before)
        assert writer.content(used) is used
        assert bytes(used) == wanted, "nothing is left of the sample before"


@SETTINGS
@given(st.lists(st.tuples(TEXTS, clouds()), max_size=3), st.lists(TEXTS, max_size=3), U32)
def test_a_reply_is_written_as_the_serializer_does(
    cells: list[tuple[str, tuple[dict[str, Any], Any]]], removed: list[str], client: int
) -> None:
    """Parts of several clouds stand at the right places."""
    box = (-1.5, 2.0, 18.5, 22.0)
    listed = [CellWithID(name, message, CellMetaData(*box)) for name, (_, message) in cells]
    header = Header(Time(0, 0), "map")
    wanted = DIFFERENTIAL.reply(client, -7, header, listed, removed).serialize(use_version_2=False)
    writer = CdrWriter()
    writer.numbers("QqiI", client, -7, 0, 0)
    writer.text("map")
    writer.numbers("I", len(cells))
    for name, (columns, message) in cells:
        writer.text(name)
        write(writer, columns, message)
        writer.numbers("ffff", *box)
    writer.texts(removed)
    assert bytes(writer.content()) == padded(wanted)


def test_numbers_of_eight_bytes_stand_where_they_should() -> None:
    grid = VoxelGrid(Header(Time(1, 2), "m"), 0.2, [1, 2, 3], [4, 5, 6], [-7, 8, 9], 3, 1, 4, -7, 3, 6, 9)
    wanted = OCCUPIED.reply(1, 2, grid, 3, 17, 0.5, 1.25, True).serialize(use_version_2=False)
    writer = CdrWriter()
    writer.numbers("QqiI", 1, 2, 1, 2)
    writer.text("m")
    writer.numbers("d", 0.2)
    for axis in ([1, 2, 3], [4, 5, 6], [-7, 8, 9]):
        writer.numbers("I", 3)
        writer.blob(12, partial(copy_into, data=bytearray(np.array(axis, "<i4").tobytes())))
    writer.numbers("Iiiiiii", 3, 1, 4, -7, 3, 6, 9)
    writer.numbers("QQff?", 3, 17, 0.5, 1.25, True)
    assert bytes(writer.content()) == padded(wanted)


def test_fields_are_those_of_autoware_s_files() -> None:
    """Of a divided map as the divider writes it: 12 bytes a point, 16 with intensity."""
    xyz, f4 = np.zeros((2, 3), "<f4"), np.zeros(2, "<f4")
    assert cloud_layout({"xyz": xyz}).point_step == 12
    layout = cloud_layout({"xyz": xyz, "intensity": f4})
    assert layout.point_step == 16
    assert layout.fields == (("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("intensity", 12, 7, 1))
    odd = cloud_layout(
        {"time": np.zeros(2, "<i8"), "xyz": xyz.astype("<f8"), "normal": np.zeros((2, 3), "<f4")}
    )
    assert odd.fields == (("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("normal", 12, 7, 3))


def test_doubles_and_origins_become_float32() -> None:
    far = np.array([89_000.0, 42_000.0, 10.0])
    xyz = np.array([[0.25, -0.5, 1.0], [3.0, 4.0, 5.0]], "<f4")
    for columns, origin in (
        ({"xyz": xyz, "ring": np.array([1, 2], "u1")}, (89_000.0, 42_000.0, 10.0)),
        ({"xyz": xyz}, (89_000.0, 42_000.0, 10.0)),
        ({"xyz": xyz.astype("<f8") + far}, (0.0, 0.0, 0.0)),
    ):
        layout = cloud_layout(columns)
        place = bytearray(2 * layout.point_step)
        with memoryview(place) as whole:
            fill_rows(whole, columns, origin, layout)
        found = np.ndarray((2, 3), "<f4", bytes(place), 0, (layout.point_step, 4))
        assert found.tolist() == (xyz.astype(float) + far).astype("f4").tolist()


def test_a_cell_without_a_column_leaves_zeros() -> None:
    layout = cloud_layout({"xyz": np.zeros((1, 3), "<f4"), "intensity": np.zeros(1, "<f4")})
    place = bytearray(b"\0" * 16)
    with memoryview(place) as whole:
        fill_rows(whole, {"xyz": np.ones((1, 3), "<f4"), "ring": np.ones(1, "u1")}, (0.0, 0.0, 0.0), layout)
    assert np.frombuffer(place, "<f4").tolist() == [1.0, 1.0, 1.0, 0.0]


def test_what_is_too_large_for_dds_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cdr, "MAX_BYTES", 100)
    writer = CdrWriter()
    writer.blob(97, lambda place: None)  # noqa: ARG005
    with pytest.raises(ValueError, match="101 bytes, of at most 100"):
        writer.content()


def test_ready_bytes_are_sent_as_they_are() -> None:
    content = Content(b"\0\1\0\0abcd")
    message = ready_made(PointCloud2, content)
    assert message.serialize() is content
    assert content.ljust(8) is content
    assert content.ljust(12, b"\0") == content + bytes(4)


def test_bytes_that_are_no_message_are_damaged() -> None:
    value = ParameterValue(4, False, 0, 0.0, "text", [], [], [], [], [])
    data = value.serialize(use_version_2=False)
    assert ParameterValue.deserialize(data) == value
    assert isinstance(ParameterValue.deserialize(data.replace(b"text", b"\xff\xff\xff\xff")), Damaged)
    for end in range(4, len(data) - 8, 3):
        found = ParameterValue.deserialize(data[:end])
        assert isinstance(found, Damaged), end


def test_hashes_are_those_of_the_types() -> None:
    """As REP 2016 makes them of the very types that are sent."""
    services = [PARTIAL, DIFFERENTIAL, SELECTED, OCCUPIED, FREE, *PARAMETER_SERVICES.values()]
    kinds = [PointCloud2, MapMetaData, *(kind for one in services for kind in (one.request, one.reply))]
    for kind in kinds:
        assert type_hash(kind) == f"typehash={type_hashes.type_hash(kind)};", kind
    assert {kind.__name__ for kind in kinds} == set(HASHES)


def test_hashes_are_those_of_ros() -> None:
    """As its packages and Autoware's have them, where they are installed, or made for the tests."""
    prefixes = [environment_folder(), *map(Path, os.environ.get("AMENT_PREFIX_PATH", "").split(":"))]
    services = [PARTIAL, DIFFERENTIAL, SELECTED, *PARAMETER_SERVICES.values()]
    found = {}
    for kind in (PointCloud2, MapMetaData, *(kind for one in services for kind in (one.request, one.reply))):
        name = type_hashes.ros_name(kind)
        file = f"{re.sub('_(Request|Response)$', '', name)}.json"
        for path in (one / "share" / file for one in prefixes if (one / "share" / file).exists()):
            for row in json.loads(path.read_text())["type_hashes"]:
                found[row["type_name"]] = row["hash_string"]
            assert type_hash(kind) == f"typehash={found[name]};"
    if not found:
        pytest.skip("needs ROS 2: python -m tests.support.ros, or AMENT_PREFIX_PATH")
