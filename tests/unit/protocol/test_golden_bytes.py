# SPDX-License-Identifier: Apache-2.0
"""Every message, byte by byte: against hex written down and a decoder independent of msgspec."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from shmmap.protocol import events as e
from shmmap.protocol import messages as m
from shmmap.protocol.codec import (
    PackedArray,
    decode_reply,
    decode_request,
    encode,
    encode_cells,
    encode_handle,
)
from tests.support.message_pack import pack, unpack

U64 = 2**64 - 1
HANDLE = m.Handle("a.pcd", 1, "points", "00", 0, 8192, 9, 0.0, 0.0, 20.0, 20.0)

# message, what PROTOCOL.md makes of it, and the bytes
REQUESTS: list[tuple[Any, list[Any], str]] = [
    (m.Hello(1, 2, 0, "c", 9), ["hello", 1, 2, 0, "c", 9], "96a568656c6c6f010200a16309"),
    (
        m.Metadata(2, m.BoxMessage(0.0, 1.0, 2.0, 3.0), 5, 6, 7),
        ["metadata", 2, ["box", 0.0, 1.0, 2.0, 3.0, None, None], 5, 6, 7],
        (
            "96a86d657461646174610297a3626f78cb0000000000000000cb3ff0000000000000cb4000000000"
            "000000cb4008000000000000c0c0050607"
        ),
    ),
    (
        m.Area(
            3,
            m.CircleMessage(1.0, -2.0, 150.0, 0.0, 5.0),
            ("points",),
            0.5,
            m.Intent(1.0, 2.0, 3.0, 4.0, 0.5, ((5.0, 6.0),)),
        ),
        [
            "area",
            3,
            ["circle", 1.0, -2.0, 150.0, 0.0, 5.0],
            ["points"],
            0.5,
            [1.0, 2.0, 3.0, 4.0, 0.5, [[5.0, 6.0]]],
        ],
        (
            "96a4617265610396a6636972636c65cb3ff0000000000000cbc000000000000000cb4062c0000000"
            "0000cb0000000000000000cb401400000000000091a6706f696e7473cb3fe000000000000096cb3f"
            "f0000000000000cb4000000000000000cb4008000000000000cb4010000000000000cb3fe0000000"
            "0000009192cb4014000000000000cb4018000000000000"
        ),
    ),
    (
        m.Differential(
            4,
            m.SquareMessage(1.0, 2.0, 3.0),
            ("points",),
            (m.HeldCell("a.pcd"), m.HeldCell("b.pcd", U64, ("points",))),
            bytes([1, 0, 0, 0, 0, 0, 0, 0]),
        ),
        [
            "differential",
            4,
            ["square", 1.0, 2.0, 3.0, None, None],
            ["points"],
            [["a.pcd", None, None], ["b.pcd", U64, ["points"]]],
            b"\x01\x00\x00\x00\x00\x00\x00\x00",
            None,
            None,
        ],
        (
            "98ac646966666572656e7469616c0496a6737175617265cb3ff0000000000000cb40000000000000"
            "00cb4008000000000000c0c091a6706f696e74739293a5612e706364c0c093a5622e706364cfffff"
            "ffffffffffff91a6706f696e7473c4080100000000000000c0c0"
        ),
    ),
    (
        m.Selected(5, ("b.pcd", "b.pcd"), ("points",), None, None),
        ["selected", 5, ["b.pcd", "b.pcd"], ["points"], None, None],
        "96a873656c65637465640592a5622e706364a5622e70636491a6706f696e7473c0c0",
    ),
    (
        m.Release(6, bytes([2, 0, 0, 0, 0, 0, 0, 0])),
        ["release", 6, b"\x02\x00\x00\x00\x00\x00\x00\x00"],
        "93a772656c6561736506c4080200000000000000",
    ),
    (m.Stats(7), ["stats", 7], "92a5737461747307"),
    (m.Show(8, "a"), ["show", 8, "a"], "93a473686f7708a161"),
    (m.Reload(9), ["reload", 9], "92a672656c6f616409"),
    (m.Evict(10, ("a",)), ["evict", 10, ["a"]], "93a565766963740a91a161"),
    (m.Bye(11), ["bye", 11], "92a36279650b"),
    (m.Pin(12, ("a",), ("points",)), ["pin", 12, ["a"], ["points"]], "94a370696e0c91a16191a6706f696e7473"),
    (m.Unpin(13, ("a",)), ["unpin", 13, ["a"]], "93a5756e70696e0d91a161"),
    (m.Shutdown(14), ["shutdown", 14], "92a873687574646f776e0e"),
    (e.Recent(15, 1, 2, 3), ["recent", 15, 1, 2, 3], "95a6726563656e740f010203"),
]
REPLIES: list[tuple[Any, list[Any], str]] = [
    (
        m.Welcome(
            1,
            1,
            0,
            "0.1.0",
            "default",
            3,
            4,
            5,
            "/m",
            "map",
            "/dev/shm",
            "/m/",
            "/shmmap.default.",
            2,
            (0.0, 1.0, 2.0, 3.0),
            ("points",),
            6,
            7,
            "/r/default.events.sock",
            (10.0, 20.0, 30.0),
            "EPSG:32632",
            (0.5, 0.25),
        ),
        [
            "welcome",
            1,
            1,
            0,
            "0.1.0",
            "default",
            3,
            4,
            5,
            "/m",
            "map",
            "/dev/shm",
            "/m/",
            "/shmmap.default.",
            2,
            [0.0, 1.0, 2.0, 3.0],
            ["points"],
            6,
            7,
            "/r/default.events.sock",
            [10.0, 20.0, 30.0],
            "EPSG:32632",
            [0.5, 0.25],
        ],
        (
            "dc0017a777656c636f6d65010100a5302e312e30a764656661756c74030405a22f6da36d6170a82f"
            "6465762f73686da32f6d2fb02f73686d6d61702e64656661756c742e0294cb0000000000000000cb"
            "3ff0000000000000cb4000000000000000cb400800000000000091a6706f696e74730607"
            "b62f722f64656661756c742e6576656e74732e736f636b"
            "93cb4024000000000000cb4034000000000000cb403e000000000000aa455053473a3332363332"
            "92cb3fe0000000000000cb3fd0000000000000"
        ),
    ),
    (
        m.Cells(
            4,
            3,
            5,
            (HANDLE,),
            ("b.pcd",),
            bytes([2, 0, 0, 0, 0, 0, 0, 0]),
            (m.PendingCell("c", "points"),),
            (
                m.FailedCell(
                    "d",
                    "points",
                    "over_budget",
                    "no",
                    (m.Holder(0, 0, 0, "unknown", 8, 1),),
                    (0.0, 0.0, 20.0, 20.0),
                ),
                m.FailedCell("e", "points", "unknown_cell", "no"),
            ),
            ("points",),
            False,
            "offline",
        ),
        [
            "cells",
            4,
            3,
            5,
            [["a.pcd", 1, "points", "00", 0, 8192, 9, 0.0, 0.0, 20.0, 20.0, False]],
            ["b.pcd"],
            b"\x02\x00\x00\x00\x00\x00\x00\x00",
            [["c", "points"]],
            [
                [
                    "d",
                    "points",
                    "over_budget",
                    "no",
                    [[0, 0, 0, "unknown", 8, 1, ""]],
                    [0.0, 0.0, 20.0, 20.0],
                ],
                ["e", "points", "unknown_cell", "no", [], None],
            ],
            ["points"],
            False,
            "offline",
        ],
        (
            "9ca563656c6c73040305919ca5612e70636401a6706f696e7473a2303000cd200009cb0000000000"
            "000000cb0000000000000000cb4034000000000000cb4034000000000000c291a5622e706364c408"
            "02000000000000009192a163a6706f696e74739296a164a6706f696e7473ab6f7665725f62756467"
            "6574a26e6f9197000000a7756e6b6e6f776e0801a094cb0000000000000000cb0000000000000000"
            "cb4034000000000000cb403400000000000096a165a6706f696e7473ac756e6b6e6f776e5f63656c"
            "6ca26e6f90c091a6706f696e7473c2a76f66666c696e65"
        ),
    ),
    (
        m.MetadataPage(2, 3, 5, (m.MetadataRow("a", 1, 0.0, 0.0, 20.0, 20.0, 300),), 1, False, ("z",)),
        ["metadata_page", 2, 3, 5, [["a", 1, 0.0, 0.0, 20.0, 20.0, 300, None, None]], 1, False, ["z"]],
        (
            "98ad6d657461646174615f706167650203059199a16101cb0000000000000000cb00000000000000"
            "00cb4034000000000000cb4034000000000000cd012cc0c001c291a17a"
        ),
    ),
    (m.Released(6), ["released", 6], "92a872656c656173656406"),
    (
        m.StatsReply(
            7,
            3,
            5,
            {"requests": 1},
            (
                m.ClientRow(
                    4,
                    5,
                    6,
                    -1,
                    "c",
                    "cmd",
                    1,
                    2,
                    3,
                    4,
                    (1.0, 2.0),
                    0.5,
                    m.Window("box", 1, 2, 3, 4),
                    8,
                    9,
                    10,
                ),
            ),
            1,
            2,
        ),
        [
            "stats_reply",
            7,
            3,
            5,
            {"requests": 1},
            [[4, 5, 6, -1, "c", "cmd", 1, 2, 3, 4, [1.0, 2.0], 0.5, ["box", 1, 2, 3, 4], 8, 9, 10]],
            1,
            2,
        ],
        (
            "98ab73746174735f7265706c7907030581a872657175657374730191dc0010040506ffa163a3636d"
            "640102030492cb3ff0000000000000cb4000000000000000cb3fe000000000000095a3626f780102"
            "030408090a0102"
        ),
    ),
    (
        m.ShownCell(
            8,
            "a",
            1,
            0.0,
            0.0,
            20.0,
            20.0,
            300,
            (
                m.CellRow(
                    "a",
                    "points",
                    1,
                    "00",
                    "zombie",
                    1,
                    2,
                    (0, 0, 20, 20),
                    3,
                    4,
                    5,
                    True,
                    (m.Holder(4, 5, 6, "c", 7, 8, "cmd"),),
                ),
            ),
            ("points",),
            "bad",
            -1.0,
            1.0,
            ("points",),
        ),
        [
            "shown_cell",
            8,
            "a",
            1,
            0.0,
            0.0,
            20.0,
            20.0,
            300,
            [
                [
                    "a",
                    "points",
                    1,
                    "00",
                    "zombie",
                    1,
                    2,
                    [0, 0, 20, 20],
                    3,
                    4,
                    5,
                    True,
                    [[4, 5, 6, "c", 7, 8, "cmd"]],
                ]
            ],
            ["points"],
            "bad",
            -1.0,
            1.0,
            ["points"],
        ],
        (
            "9faa73686f776e5f63656c6c08a16101cb0000000000000000cb0000000000000000cb4034000000"
            "000000cb4034000000000000cd012c919da161a6706f696e747301a23030a67a6f6d626965010294"
            "00001414030405c39197040506a1630708a3636d6491a6706f696e7473a3626164cbbff000000000"
            "0000cb3ff000000000000091a6706f696e7473"
        ),
    ),
    (
        m.Reloaded(9, 5, 1, 2, 3, ("odd",)),
        ["reloaded", 9, 5, 1, 2, 3, ["odd"]],
        "97a872656c6f61646564090501020391a36f6464",
    ),
    (
        m.Evicted(10, 1, 2, ("x",), 3),
        ["evicted", 10, 1, 2, ["x"], 3],
        "96a7657669637465640a010291a17803",
    ),
    (
        m.Pinned(12, (m.PinnedCell("a", "points", "resident", 5),), ("x",)),
        ["pinned", 12, [["a", "points", "resident", 5]], ["x"]],
        "94a670696e6e65640c9194a161a6706f696e7473a87265736964656e740591a178",
    ),
    (m.Stopping(14), ["stopping", 14], "92a873746f7070696e670e"),
    (
        e.EventPage(15, 3, 1, 2, (msgspec.Raw(bytes.fromhex("94a462656174010305")),)),
        ["events", 15, 3, 1, 2, [["beat", 1, 3, 5]]],
        "96a66576656e74730f0301029194a462656174010305",
    ),
    (
        m.ErrorReply(11, "no_session", "m", "h"),
        ["error", 11, "no_session", "m", "h"],
        "95a56572726f720baa6e6f5f73657373696f6ea16da168",
    ),
]


@pytest.mark.parametrize(
    ("message", "elements", "golden"), REQUESTS + REPLIES, ids=lambda v: type(v).__name__
)
def test_packs_to_the_golden_bytes(message: msgspec.Struct, elements: list[Any], golden: str) -> None:
    assert encode(message) == bytes.fromhex(golden)
    assert unpack(bytes.fromhex(golden)) == elements
    assert pack(elements) == bytes.fromhex(golden)  # both encoders choose the shortest form


@pytest.mark.parametrize(("message", "elements", "golden"), REQUESTS, ids=lambda v: type(v).__name__)
def test_requests_unpack_from_the_golden_bytes(message: object, elements: list[Any], golden: str) -> None:
    assert decode_request(bytes.fromhex(golden)) == message


@pytest.mark.parametrize(("message", "elements", "golden"), REPLIES, ids=lambda v: type(v).__name__)
def test_replies_unpack_from_the_golden_bytes(message: object, elements: list[Any], golden: str) -> None:
    assert decode_reply(bytes.fromhex(golden)) == message


@pytest.mark.parametrize(("message", "elements", "golden"), REQUESTS, ids=lambda v: type(v).__name__)
def test_requests_of_a_later_minor_version_are_read(
    message: object, elements: list[Any], golden: str
) -> None:
    assert decode_request(pack([*elements, "something new", [1, {"a": None}]])) == message


@pytest.mark.parametrize(("message", "elements", "golden"), REPLIES, ids=lambda v: type(v).__name__)
def test_replies_of_a_later_minor_version_are_read(message: object, elements: list[Any], golden: str) -> None:
    assert decode_reply(pack([*elements, "something new"])) == message


@pytest.mark.parametrize(
    ("short", "full"),
    [
        (["hello", 1, 2, 0], m.Hello(1, 2, 0, "", 0)),
        (["metadata", 1], m.Metadata(1, None, None, 0, 1000)),
        (
            ["area", 1, ["box", 0, 1, 2, 3]],
            m.Area(1, m.BoxMessage(0.0, 1.0, 2.0, 3.0), ("points",), None, None),
        ),
        (
            ["differential", 1, ["circle", 0, 1, 2]],
            m.Differential(1, m.CircleMessage(0.0, 1.0, 2.0, None, None), ("points",), (), b"", None, None),
        ),
        (["selected", 1, ["a"]], m.Selected(1, ("a",), ("points",), None, None)),
        (["release", 1], m.Release(1, None)),
        (["evict", 1], m.Evict(1, None)),
        (["recent", 1], e.Recent(1, 0, 0, 500)),
        (["pin", 1], m.Pin(1, (), ("points",))),
        (["unpin", 1], m.Unpin(1, None)),
        (
            ["area", 1, ["square", 0.5, 1, 2], [], 0, [1, 2]],
            m.Area(1, m.SquareMessage(0.5, 1.0, 2.0), (), 0.0, m.Intent(1.0, 2.0, 0.0, 0.0, None, ())),
        ),
    ],
)
def test_defaults_as_documented(short: list[Any], full: object) -> None:
    assert decode_request(pack(short)) == full


def test_a_handle_packed_once_is_the_same_bytes_inside_a_reply() -> None:
    raw = msgspec.Raw(encode_handle(HANDLE))
    reply = ("cells", 4, 3, 5, [raw, raw], (), b"", (), ())
    assert decode_reply(encode(reply)) == m.Cells(4, 3, 5, (HANDLE, HANDLE))


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 65535, 65536])
def test_a_reply_put_together_from_packed_handles_is_the_same_bytes(count: int) -> None:
    """At every size at which MessagePack changes the form of an array."""
    whole = m.Cells(
        4, U64, 5, (HANDLE,) * count, ("b.pcd",), bytes(8), (m.PendingCell("c", "points"),),
        (m.FailedCell("d", "points", "x", "y"),), ("points", "voxel(leaf=1.0)"), False, "offline",
    )  # fmt: skip
    together = encode_cells(
        4, U64, 5, [encode_handle(HANDLE)] * count, whole.removed, whole.removed_packed,
        whole.layers, whole.covered, PackedArray(whole.pending), PackedArray(whole.failed),
        reason=whole.reason,
    )  # fmt: skip
    assert together == encode(whole)
    assert encode_cells(4, 3, 5, [], (), b"", ()) == encode(m.Cells(4, 3, 5))


@pytest.mark.parametrize(("minor", "elements"), [(2, 9), (5, 11)])
def test_a_reply_of_an_older_daemon(minor: int, elements: int) -> None:
    """Before 1.3 it has neither layers nor covered: of what it answered it knew everything."""
    (golden,) = [hexed for message, _, hexed in REPLIES if isinstance(message, m.Cells)]
    older = unpack(bytes.fromhex(golden))[:elements]
    older[8] = [failed[:5] for failed in older[8]]  # before 1.6 it does not say where a cell lies
    reply = decode_reply(pack(older))
    assert isinstance(reply, m.Cells)
    assert (reply.layers, reply.covered) == (((), True) if minor < 3 else (("points",), False))
    assert (reply.reason, [failed.box for failed in reply.failed]) == ("", [None, None])


def test_replies_with_cells_have_only_grown_at_their_end() -> None:
    (golden,) = [hexed for message, _, hexed in REPLIES if isinstance(message, m.Cells)]
    older = pack(unpack(bytes.fromhex(golden))[:8])
    assert bytes.fromhex(golden)[1 : len(older)] == older[1:]


def test_numbers_that_numpy_computed() -> None:
    plain = m.Intent(1.5, 2.0, 3.0, 0.0, None, ())
    numpy = m.Intent(np.float32(1.5), np.float64(2), np.int64(3))
    assert unpack(encode(numpy))[:3] == unpack(encode(plain))[:3]
    with pytest.raises(TypeError):
        encode(m.Show(1, object()))  # type: ignore[arg-type]


def test_a_warm_handle_stays_under_200_bytes() -> None:
    long = m.Handle(
        "pointcloud_map_-123456_-654321.pcd", U64, "points", "f" * 16, 0, 2**32, 2**32,
        -123456.5, -654321.5, -123436.5, -654301.5,
    )  # fmt: skip
    assert len(encode_handle(long)) < 200
