# SPDX-License-Identifier: Apache-2.0
"""Messages about live maps, byte by byte."""

from __future__ import annotations

from typing import Any, get_args

import pytest

from shmmap.protocol import live as l
from shmmap.protocol import messages as m
from shmmap.protocol.codec import decode_reply, decode_request, encode
from tests.support.message_pack import pack, unpack

U64 = 2**64 - 1

REQUESTS: list[tuple[Any, list[Any], str]] = [
    (
        l.LiveList(1),
        ["live_list", 1],
        "92a96c6976655f6c69737401",
    ),
    (
        l.LiveOpen(2, "lidar", "front", "map"),
        ["live_open", 2, "lidar", "front", "map"],
        "95a96c6976655f6f70656e02a56c69646172a566726f6e74a36d6170",
    ),
    (
        l.LiveScan(3, "lidar", 1, 2**63, "3f2a.17", 4096, (1.0, -2.0, 0.5)),
        ["live_scan", 3, "lidar", 1, 2**63, "3f2a.17", 4096, [1.0, -2.0, 0.5]],
        (
            "98a96c6976655f7363616e03a56c6964617201cf8000000000000000a7336632612e3137cd100093"
            "cb3ff0000000000000cbc000000000000000cb3fe0000000000000"
        ),
    ),
    (
        l.LiveMove(4, "lidar", (1.0, -2.0, 0.5)),
        ["live_move", 4, "lidar", [1.0, -2.0, 0.5]],
        ("94a96c6976655f6d6f766504a56c6964617293cb3ff0000000000000cbc000000000000000cb3fe0000000000000"),
    ),
    (
        l.LiveSave(5, "lidar"),
        ["live_save", 5, "lidar"],
        "93a96c6976655f7361766505a56c69646172",
    ),
    (
        l.LiveChunks(6, "lidar", l.SphereMessage(1.0, 2.0, 3.0, 4.0), 7, True, (-1, 0, 2)),
        ["live_chunks", 6, "lidar", ["sphere", 1.0, 2.0, 3.0, 4.0], 7, True, [-1, 0, 2]],
        (
            "97ab6c6976655f6368756e6b7306a56c6964617295a6737068657265cb3ff0000000000000cb4000"
            "000000000000cb4008000000000000cb401000000000000007c393ff0002"
        ),
    ),
    (
        l.LiveVoxels(7, "lidar", "free", m.BoxMessage(0.0, 1.0, 2.0, 3.0, -1.0, 1.0), "all", 9),
        ["live_voxels", 7, "lidar", "free", ["box", 0.0, 1.0, 2.0, 3.0, -1.0, 1.0], "all", 9],
        (
            "97ab6c6976655f766f78656c7307a56c69646172a46672656597a3626f78cb0000000000000000cb"
            "3ff0000000000000cb4000000000000000cb4008000000000000cbbff0000000000000cb3ff00000"
            "00000000a3616c6c09"
        ),
    ),
    (
        l.LiveRelease(8, "lidar", "/shmmap-live.default.lidar.voxels.00"),
        ["live_release", 8, "lidar", "/shmmap-live.default.lidar.voxels.00"],
        (
            "94ac6c6976655f72656c6561736508a56c69646172d9242f73686d6d61702d6c6976652e64656661"
            "756c742e6c696461722e766f78656c732e3030"
        ),
    ),
]

REPLIES: list[tuple[Any, list[Any], str]] = [
    (
        l.LiveListed(
            1,
            (
                l.LiveMapRow(
                    "lidar",
                    "/map",
                    0.2,
                    "map",
                    0,
                    1,
                    2,
                    3,
                    4,
                    5,
                    6,
                    7,
                    8,
                    9,
                    10,
                    11,
                    ("a",),
                    ("0/front",),
                    "full",
                    12,
                    13,
                    ((14, 15),),
                    16,
                    17,
                ),
            ),
        ),
        [
            "live_listed",
            1,
            [
                [
                    "lidar",
                    "/map",
                    0.2,
                    "map",
                    0,
                    1,
                    2,
                    3,
                    4,
                    5,
                    6,
                    7,
                    8,
                    9,
                    10,
                    11,
                    ["a"],
                    ["0/front"],
                    "full",
                    12,
                    13,
                    [[14, 15]],
                    16,
                    17,
                ]
            ],
        ],
        (
            "93ab6c6976655f6c69737465640191dc0018a56c69646172a42f6d6170cb3fc999999999999aa36d"
            "6170000102030405060708090a0b91a16191a7302f66726f6e74a466756c6c0c0d91920e0f1011"
        ),
    ),
    (
        l.LiveOpened(
            2,
            bytes(16),
            0.2,
            "map",
            847,
            -405,
            -1992,
            3476,
            0,
            0,
            "/dev/shm",
            "/p.",
            "/m",
            1,
            5,
            9,
            (0.7, 0.4),
            77,
        ),
        [
            "live_opened",
            2,
            b"\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00",
            0.2,
            "map",
            847,
            -405,
            -1992,
            3476,
            0,
            0,
            "/dev/shm",
            "/p.",
            "/m",
            1,
            5,
            9,
            [0.7, 0.4],
            77,
        ],
        (
            "dc0013ab6c6976655f6f70656e656402c41000000000000000000000000000000000cb3fc9999999"
            "99999aa36d6170cd034fd1fe6bd1f838cd0d940000a82f6465762f73686da32f702e"
            "a22f6d01050992cb3fe6666666666666cb3fd999999999999a4d"
        ),
    ),
    (
        l.LiveApplied(3, 5, 4),
        ["live_applied", 3, 5, 4],
        "94ac6c6976655f6170706c696564030504",
    ),
    (
        l.LiveMoved(4, U64),
        ["live_moved", 4, U64],
        "93aa6c6976655f6d6f76656404cfffffffffffffffff",
    ),
    (
        l.LiveDurable(5, 6, 7),
        ["live_durable", 5, 6, 7],
        "94ac6c6976655f64757261626c65050607",
    ),
    (
        l.LiveChunkPage(
            6, 7, (l.LiveChunkRow((-1, 0, 2), 3, 4, "dirty", 5, 6, 7, 8),), True, ((1, 2, 3),), False
        ),
        ["live_chunk_page", 6, 7, [[[-1, 0, 2], 3, 4, "dirty", 5, 6, 7, 8]], True, [[1, 2, 3]], False],
        ("97af6c6976655f6368756e6b5f706167650607919893ff00020304a5646972747905060708c39193010203c2"),
    ),
    (
        l.LiveVoxelsReply(7, 8, "/s", 9, 126),
        ["live_voxels_reply", 7, 8, "/s", 9, 126],
        "96b16c6976655f766f78656c735f7265706c790708a22f73097e",
    ),
    (
        l.LiveReleased(8),
        ["live_released", 8],
        "92ad6c6976655f72656c656173656408",
    ),
]


def kinds(value: object) -> str:
    return type(value).__name__


@pytest.mark.parametrize(("message", "elements", "golden"), [*REQUESTS, *REPLIES], ids=kinds)
def test_packs_to_the_golden_bytes(message: object, elements: list[Any], golden: str) -> None:
    assert encode(message).hex() == pack(elements).hex() == golden
    assert unpack(bytes.fromhex(golden)) == elements


@pytest.mark.parametrize(("message", "elements", "golden"), REQUESTS, ids=kinds)
def test_requests_unpack_from_the_golden_bytes(message: object, elements: list[Any], golden: str) -> None:
    assert decode_request(bytes.fromhex(golden)) == message
    assert decode_request(pack([*elements, "later"])) == message


@pytest.mark.parametrize(("message", "elements", "golden"), REPLIES, ids=kinds)
def test_replies_unpack_from_the_golden_bytes(message: object, elements: list[Any], golden: str) -> None:
    assert decode_reply(bytes.fromhex(golden)) == message
    assert decode_reply(pack([*elements, "later"])) == message


def test_every_message_about_live_maps_is_here() -> None:
    assert {type(row[0]) for row in REQUESTS} == set(l.LIVE_REQUESTS)
    assert {type(row[0]) for row in REPLIES} == set(get_args(l.LiveReply))
