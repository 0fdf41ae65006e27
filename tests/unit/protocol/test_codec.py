# SPDX-License-Identifier: Apache-2.0
"""No message: refused by name.  Replies put together are those encoded at once.  Areas survive the wire."""

from __future__ import annotations

import math
import tracemalloc

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap import geometry
from shmmap.errors import BadRequest, ProtocolMismatch
from shmmap.protocol.codec import (
    decode_reply,
    decode_request,
    encode,
    encode_cells,
    encode_handle,
    pack_versions,
    request_number,
    unpack_versions,
)
from shmmap.protocol.messages import (
    Area,
    Cells,
    FailedCell,
    Handle,
    Hello,
    Holder,
    PendingCell,
    area_from_message,
    area_to_message,
)
from tests.support.message_pack import pack

coordinate = st.floats(-1e7, 1e7)

length = st.floats(0, 1e5)
z_range = st.none() | st.tuples(coordinate, length).map(lambda p: (p[0], p[0] + p[1]))
areas = (
    st.builds(geometry.Circle, coordinate, coordinate, length, z_range)
    | st.builds(geometry.AutowareSquare, coordinate, coordinate, length, z_range)
    | st.tuples(coordinate, coordinate, length, length, z_range).map(
        lambda b: geometry.Box(b[0], b[1], b[0] + b[2], b[1] + b[3], b[4])
    )
)

BAD = [
    b"",
    b"\xc1",
    b"\x90",
    b"\xc0",
    b"\x81\xa1a\x01",
    b"\xdd\xff\xff\xff\xff",  # four thousand million elements
    b"\xdb\xff\xff\xff\xff",
    b"\x91" * 5000,  # nested too deep
    pack(["hello"]),
    pack(["nonsense", 1]),
    pack([1, 1]),
    pack(["hello", "one", 1, 0]),
    pack(["area", 1, ["triangle", 1, 2, 3]]),
    pack(["area", 1, ["circle", 1, 2]]),
    pack(["area", 1, ["circle", "1", 2, 3]]),
    pack(["selected", 1, "abc"]),
    pack(["selected", 1, [1]]),
    pack(["differential", 1, ["circle", 1, 2, 3], ["points"], [], "text"]),
    b"\x93\xa8selected\x01\x91\xa2\xff\xfe",  # text that is no UTF-8
]


@pytest.mark.parametrize("data", BAD)
def test_what_is_no_request_is_refused(data: bytes) -> None:
    with pytest.raises(BadRequest):
        decode_request(data)


@pytest.mark.parametrize("data", [*BAD, encode(Hello(1, 1, 0))])
def test_what_is_no_reply_is_refused(data: bytes) -> None:
    with pytest.raises(ProtocolMismatch):
        decode_reply(data)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_refused(data: bytes) -> None:
    for decode, refusal in ((decode_request, BadRequest), (decode_reply, ProtocolMismatch)):
        try:
            message = decode(data)
        except refusal:
            continue
        assert message.request is not None


@pytest.mark.parametrize(
    ("data", "number"),
    [
        (pack(["nonsense", 7]), 7),
        (pack(["area", 2**64 - 1, "bad"]), 2**64 - 1),
        (pack(["area", -1]), 0),
        (pack(["area", "7"]), 0),
        (pack(["area"]), 0),
        (pack({"area": 7}), 0),
        (b"\xc1", 0),
        (b"", 0),
    ],
)
def test_the_id_of_a_bad_request_is_found_where_there_is_one(data: bytes, number: int) -> None:
    assert request_number(data) == number


@given(areas)
def test_areas_survive_the_wire(area: geometry.Area) -> None:
    message = decode_request(encode(Area(1, area_to_message(area))))
    assert isinstance(message, Area)
    assert area_from_message(message.area) == area


@pytest.mark.parametrize(
    "area",
    [
        ["circle", math.nan, 0, 1],
        ["circle", 0, math.inf, 1],
        ["circle", 0, 0, -1],
        ["circle", 0, 0, math.nan],
        ["square", 0, 0, -0.5],
        ["square", 1e39, 0, 1],
        ["box", 1, 0, 0, 1],
        ["box", 0, 0, math.inf, 1],
        ["circle", 0, 0, 1, 5, 4],
        ["circle", 0, 0, 1, math.nan, 4],
        ["circle", 0, 0, 1, 4],
        ["square", 0, 0, 1, None, 4],
        ["box", 0, 0, 1, 1, 4, None],
    ],
)
def test_areas_that_make_no_sense_are_refused(area: list[object]) -> None:
    message = decode_request(pack(["area", 1, area]))
    assert isinstance(message, Area)
    with pytest.raises(BadRequest):
        area_from_message(message.area)


@given(st.lists(st.integers(0, 2**64 - 1)))
def test_packed_versions(versions: list[int]) -> None:
    packed = pack_versions(versions)
    assert packed == b"".join(v.to_bytes(8, "little") for v in versions)
    assert list(unpack_versions(packed)) == versions


@pytest.mark.parametrize("count", [1, 7, 9, 15])
def test_packed_versions_cut_short_are_refused(count: int) -> None:
    with pytest.raises(BadRequest):
        unpack_versions(bytes(count))


@pytest.mark.parametrize(
    "request_",
    [
        ["selected", 7, ["x"] * 1_000_000],
        ["evict", 7, ["x"] * 1_000_000],
        ["pin", 7, ["x"] * 1_000_000],
        ["area", 7, ["circle", 0.0, 0.0, 1.0], ["points"] * 500_000],
        ["differential", 7, ["circle", 0.0, 0.0, 1.0], ["points"], [["x"]] * 600_000],
        ["area", 7, ["circle", 0.0, 0.0, 1.0], ["points"], None, [0, 0, 0, 0, None, [[0, 0]] * 500_000]],
    ],
)
def test_lists_that_are_too_long_are_refused_unread(request_: list[object]) -> None:
    """At their length, whatever their elements are: nothing of them is made."""
    data = msgspec.msgpack.encode(request_)
    tracemalloc.start()
    try:
        with pytest.raises(BadRequest, match="of length <="):
            decode_request(data)
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()


numbers = st.integers(0, (1 << 64) - 1)

small = st.integers(0, 1 << 40)

texts = st.text(st.characters(codec="utf-8"), max_size=40)

floats = st.floats(allow_nan=False)

handles = st.builds(
    Handle, texts, numbers, texts, texts, small, small, small, floats, floats, floats, floats, st.booleans()
)

holders = st.builds(Holder, numbers, small, st.integers(-1, 1 << 32), texts, small, small)

failed_cells = st.builds(FailedCell, texts, texts, texts, texts, st.lists(holders, max_size=3).map(tuple))


@settings(max_examples=200, deadline=None)
@given(
    st.tuples(numbers, numbers, numbers),
    st.lists(handles, max_size=4),
    st.lists(texts, max_size=20),  # 16 and more have another head
    st.binary(max_size=80),
    st.lists(st.builds(PendingCell, texts, texts), max_size=20),
    st.lists(failed_cells, max_size=4),
    st.lists(texts, max_size=3),
    st.booleans(),
    texts,
    texts,
)
def test_any_content(
    ids: tuple[int, int, int],
    cells: list[Handle],
    removed: list[str],
    packed: bytes,
    pending: list[PendingCell],
    failures: list[FailedCell],
    layers: list[str],
    covered: bool,
    reason: str,
    next_id: str,
) -> None:
    whole = Cells(
        *ids,
        tuple(cells),
        tuple(removed),
        packed,
        tuple(pending),
        tuple(failures),
        tuple(layers),
        covered,
        reason,
        next_id,
    )
    parts = encode_cells(
        *ids, [encode_handle(h) for h in cells], tuple(removed), packed, tuple(layers),
        covered=covered, pending=pending, failed=failures, reason=reason, next_id=next_id,
    )  # fmt: skip
    assert parts == encode(whole)
    assert decode_reply(parts) == whole


@pytest.mark.parametrize("count", [0, 1, 15, 16, 255, 256, 65535, 65536, 70000])
def test_any_number_of_handles(count: int) -> None:
    """The head of a MessagePack array has one byte, three or five."""
    handle = Handle("a.pcd", 1, "points", "0" * 16, 0, 4096, 10, 0.0, 0.0, 20.0, 20.0)
    parts = encode_cells(1, 2, 3, [encode_handle(handle)] * count, (), b"", ())
    assert parts == encode(Cells(1, 2, 3, (handle,) * count))


@pytest.mark.parametrize("count", [0, 15, 16, 65535, 65536])
def test_any_number_of_removed_ids(count: int) -> None:
    removed = ("x",) * count
    assert encode_cells(1, 2, 3, (), removed, b"", ()) == encode(Cells(1, 2, 3, (), removed))
    assert encode_cells(1, 2, 3, (), (), bytes(count), ()) == encode(Cells(1, 2, 3, (), (), bytes(count)))
