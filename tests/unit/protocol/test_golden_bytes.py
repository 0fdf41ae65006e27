# SPDX-License-Identifier: Apache-2.0
"""Every message, byte by byte: against hex written down and a decoder independent of msgspec."""

from __future__ import annotations

from typing import Any, get_args

import msgspec
import pytest

from shmmap.errors import ProtocolMismatch
from shmmap.protocol import areas, live
from shmmap.protocol import events as e
from shmmap.protocol import messages as m
from shmmap.protocol.codec import (
    decode_reply,
    decode_request,
    encode,
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
            "a.pcd",
        ),
        [
            "area",
            3,
            ["circle", 1.0, -2.0, 150.0, 0.0, 5.0],
            ["points"],
            0.5,
            [1.0, 2.0, 3.0, 4.0, 0.5, [[5.0, 6.0]]],
            "a.pcd",
        ],
        (
            "97a4617265610396a6636972636c65cb3ff0000000000000cbc000000000000000cb4062c0000000"
            "0000cb0000000000000000cb401400000000000091a6706f696e7473cb3fe000000000000096cb3f"
            "f0000000000000cb4000000000000000cb4008000000000000cb4010000000000000cb3fe0000000"
            "0000009192cb4014000000000000cb4018000000000000a5612e706364"
        ),
    ),
    (
        m.Differential(
            4,
            m.SquareMessage(1.0, 2.0, 3.0),
            ("points",),
            (m.HeldCell("a.pcd"), m.HeldCell("b.pcd", U64, ("points",))),
            bytes([1, 0, 0, 0, 0, 0, 0, 0]),
            None,
            None,
            "b.pcd",
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
            "b.pcd",
        ],
        (
            "99ac646966666572656e7469616c0496a6737175617265cb3ff0000000000000cb40000000000000"
            "00cb4008000000000000c0c091a6706f696e74739293a5612e706364c0c093a5622e706364cfffff"
            "ffffffffffff91a6706f696e7473c4080100000000000000c0c0a5622e706364"
        ),
    ),
    (
        m.Selected(5, ("b.pcd", "b.pcd"), ("points",), None, None, True),
        ["selected", 5, ["b.pcd", "b.pcd"], ["points"], None, None, True],
        "97a873656c65637465640592a5622e706364a5622e70636491a6706f696e7473c0c0c3",
    ),
    (
        m.Release(6, bytes([2, 0, 0, 0, 0, 0, 0, 0])),
        ["release", 6, b"\x02\x00\x00\x00\x00\x00\x00\x00"],
        "93a772656c6561736506c4080200000000000000",
    ),
    (m.Stats(7), ["stats", 7], "92a5737461747307"),
    (m.ListCells(15, 300), ["list_cells", 15, 300], "93aa6c6973745f63656c6c730fcd012c"),
    (m.Show(8, "a"), ["show", 8, "a"], "93a473686f7708a161"),
    (m.Reload(9), ["reload", 9], "92a672656c6f616409"),
    (m.Evict(10, ("a",)), ["evict", 10, ["a"]], "93a565766963740a91a161"),
    (m.Bye(11), ["bye", 11], "92a36279650b"),
    (m.Pin(12, ("a",), ("points",)), ["pin", 12, ["a"], ["points"]], "94a370696e0c91a16191a6706f696e7473"),
    (m.Unpin(13, ("a",)), ["unpin", 13, ["a"]], "93a5756e70696e0d91a161"),
    (m.Shutdown(14), ["shutdown", 14], "92a873687574646f776e0e"),
    (m.Cancel(5), ["cancel", 5], "92a663616e63656c05"),
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
            "a.pcd",
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
            "a.pcd",
        ],
        (
            "9da563656c6c73040305919ca5612e70636401a6706f696e7473a2303000cd200009cb0000000000"
            "000000cb0000000000000000cb4034000000000000cb4034000000000000c291a5622e706364c408"
            "02000000000000009192a163a6706f696e74739296a164a6706f696e7473ab6f7665725f62756467"
            "6574a26e6f9197000000a7756e6b6e6f776e0801a094cb0000000000000000cb0000000000000000"
            "cb4034000000000000cb403400000000000096a165a6706f696e7473ac756e6b6e6f776e5f63656c"
            "6ca26e6f90c091a6706f696e7473c2a76f66666c696e65a5612e706364"
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
        m.CellsPage(15, 3, (m.CellRow("a", "points", 1, "00", "stale", 1, 2, (0, 0, 20, 20), 3, 4, 5),), 7),
        [
            "cells_page",
            15,
            3,
            [["a", "points", 1, "00", "stale", 1, 2, [0, 0, 20, 20], 3, 4, 5, False, []]],
            7,
        ],
        "95aa63656c6c735f706167650f03919da161a6706f696e747301a23030a57374616c6501029400001414030405c29007",
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

LIVE_REQUESTS: list[tuple[Any, list[Any], str]] = [
    (
        live.LiveList(1),
        ["live_list", 1],
        "92a96c6976655f6c69737401",
    ),
    (
        live.LiveOpen(2, "lidar", "front", "map"),
        ["live_open", 2, "lidar", "front", "map"],
        "95a96c6976655f6f70656e02a56c69646172a566726f6e74a36d6170",
    ),
    (
        live.LiveScan(3, "lidar", 1, 2**63, "3f2a.17", 4096, (1.0, -2.0, 0.5)),
        ["live_scan", 3, "lidar", 1, 2**63, "3f2a.17", 4096, [1.0, -2.0, 0.5]],
        (
            "98a96c6976655f7363616e03a56c6964617201cf8000000000000000a7336632612e3137cd100093"
            "cb3ff0000000000000cbc000000000000000cb3fe0000000000000"
        ),
    ),
    (
        live.LiveMove(4, "lidar", (1.0, -2.0, 0.5)),
        ["live_move", 4, "lidar", [1.0, -2.0, 0.5]],
        ("94a96c6976655f6d6f766504a56c6964617293cb3ff0000000000000cbc000000000000000cb3fe0000000000000"),
    ),
    (
        live.LiveSave(5, "lidar"),
        ["live_save", 5, "lidar"],
        "93a96c6976655f7361766505a56c69646172",
    ),
    (
        live.LiveChunks(6, "lidar", areas.SphereMessage(1.0, 2.0, 3.0, 4.0), 7, True, (-1, 0, 2)),
        ["live_chunks", 6, "lidar", ["sphere", 1.0, 2.0, 3.0, 4.0], 7, True, [-1, 0, 2]],
        (
            "97ab6c6976655f6368756e6b7306a56c6964617295a6737068657265cb3ff0000000000000cb4000"
            "000000000000cb4008000000000000cb401000000000000007c393ff0002"
        ),
    ),
    (
        live.LiveVoxels(7, "lidar", "free", m.BoxMessage(0.0, 1.0, 2.0, 3.0, -1.0, 1.0), "all", 9),
        ["live_voxels", 7, "lidar", "free", ["box", 0.0, 1.0, 2.0, 3.0, -1.0, 1.0], "all", 9],
        (
            "97ab6c6976655f766f78656c7307a56c69646172a46672656597a3626f78cb0000000000000000cb"
            "3ff0000000000000cb4000000000000000cb4008000000000000cbbff0000000000000cb3ff00000"
            "00000000a3616c6c09"
        ),
    ),
    (
        live.LiveRelease(8, "lidar", "/shmmap-live.default.lidar.voxels.00"),
        ["live_release", 8, "lidar", "/shmmap-live.default.lidar.voxels.00"],
        (
            "94ac6c6976655f72656c6561736508a56c69646172d9242f73686d6d61702d6c6976652e64656661"
            "756c742e6c696461722e766f78656c732e3030"
        ),
    ),
]

LIVE_REPLIES: list[tuple[Any, list[Any], str]] = [
    (
        live.LiveListed(
            1,
            (
                live.LiveMapRow(
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
        live.LiveOpened(
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
        live.LiveApplied(3, 5, 4),
        ["live_applied", 3, 5, 4],
        "94ac6c6976655f6170706c696564030504",
    ),
    (
        live.LiveMoved(4, U64),
        ["live_moved", 4, U64],
        "93aa6c6976655f6d6f76656404cfffffffffffffffff",
    ),
    (
        live.LiveDurable(5, 6, 7),
        ["live_durable", 5, 6, 7],
        "94ac6c6976655f64757261626c65050607",
    ),
    (
        live.LiveChunkPage(
            6,
            7,
            (live.LiveChunkRow((-1, 0, 2), 3, 4, "dirty", 5, 6, 7, 8),),
            True,
            ((1, 2, 3),),
            False,
            (live.LackingChunk((-1, 0, 3), "gone"),),
            9,
        ),
        [
            "live_chunk_page",
            6,
            7,
            [[[-1, 0, 2], 3, 4, "dirty", 5, 6, 7, 8]],
            True,
            [[1, 2, 3]],
            False,
            [[[-1, 0, 3], "gone"]],
            9,
        ],
        (
            "99af6c6976655f6368756e6b5f706167650607919893ff00020304a5646972747905060708c39193010203c2919293ff0003a4676f6e6509"
        ),
    ),
    (
        live.LiveVoxelsReply(7, 8, "/s", 9, 126, (live.LackingChunk((-1, 0, 3), "gone"),), 2),
        ["live_voxels_reply", 7, 8, "/s", 9, 126, [[[-1, 0, 3], "gone"]], 2],
        "98b16c6976655f766f78656c735f7265706c790708a22f73097e919293ff0003a4676f6e6502",
    ),
    (
        live.LiveReleased(8),
        ["live_released", 8],
        "92ad6c6976655f72656c656173656408",
    ),
]

EVENTS: list[tuple[Any, list[Any], str]] = [
    (
        e.Epoch(1, 2, 3, "started", 4, 5, 6),
        ["epoch", 1, 2, 3, "started", 4, 5, 6],
        "98a565706f6368010203a773746172746564040506",
    ),
    (
        e.Loaded(1, 2, 3, "a", "points", 4, 5, 6, 7, True, 8, True),
        ["loaded", 1, 2, 3, "a", "points", 4, 5, 6, 7, True, 8, True],
        "9da66c6f61646564010203a161a6706f696e747304050607c308c3",
    ),
    (
        e.Changed(1, 2, 3, "a", 4, "changed"),
        ["changed", 1, 2, 3, "a", 4, "changed"],
        "97a76368616e676564010203a16104a76368616e676564",
    ),
    (
        e.Evicted(1, 2, 3, "a", "points", 4, 5, "room"),
        ["evicted", 1, 2, 3, "a", "points", 4, 5, "room"],
        "99a765766963746564010203a161a6706f696e74730405a4726f6f6d",
    ),
    (
        e.Failed(1, 2, 3, "a", "points", "load_failed", "no", 0.5),
        ["failed", 1, 2, 3, "a", "points", "load_failed", "no", 0.5],
        "99a66661696c6564010203a161a6706f696e7473ab6c6f61645f6661696c6564a26e6fcb3fe0000000000000",
    ),
    (
        e.Retried(1, 2, 3, "a", "points", "load_failed"),
        ["retried", 1, 2, 3, "a", "points", "load_failed"],
        "97a772657472696564010203a161a6706f696e7473ab6c6f61645f6661696c6564",
    ),
    (
        e.Pressure(1, 2, 3, "a", "points", "over_budget", 4, 5, 6, 7, 8),
        ["pressure", 1, 2, 3, "a", "points", "over_budget", 4, 5, 6, 7, 8],
        "9ca87072657373757265010203a161a6706f696e7473ab6f7665725f6275646765740405060708",
    ),
    (
        e.PrefetchMiss(1, 2, 3, 4, 5, "c", 6, "a", "points"),
        ["prefetch_miss", 1, 2, 3, 4, 5, "c", 6, "a", "points"],
        "9aad70726566657463685f6d6973730102030405a16306a161a6706f696e7473",
    ),
    (
        e.Reloaded(1, 2, 3, 4, 5, 6, 7, 8, "no"),
        ["reload", 1, 2, 3, 4, 5, 6, 7, 8, "no"],
        "9aa672656c6f61640102030405060708a26e6f",
    ),
    (
        e.LongTurn(1, 2, 3, "requests", 12_000_000),
        ["long_turn", 1, 2, 3, "requests", 12_000_000],
        "96a96c6f6e675f7475726e010203a87265717565737473ce00b71b00",
    ),
    (
        e.Joined(1, 2, 3, 4, 5, 6, "c"),
        ["joined", 1, 2, 3, 4, 5, 6, "c"],
        "98a66a6f696e6564010203040506a163",
    ),
    (e.Left(1, 2, 3, 4, 5, "c", 6), ["left", 1, 2, 3, 4, 5, "c", 6], "98a46c6566740102030405a16306"),
    (
        e.LiveStarted(1, 2, 3, 4, 5),
        ["live_started", 1, 2, 3, 4, 5],
        "96ac6c6976655f737461727465640102030405",
    ),
    (
        e.LiveEnded(1, 2, 3, 4),
        ["live_ended", 1, 2, 3, 4],
        "95aa6c6976655f656e64656401020304",
    ),
    (
        e.LiveProblem(1, 2, 3, "m", "full"),
        ["live_problem", 1, 2, 3, "m", "full"],
        "96ac6c6976655f70726f626c656d010203a16da466756c6c",
    ),
    (
        e.LiveDamaged(1, 2, 3, "m", "torn"),
        ["live_damaged", 1, 2, 3, "m", "torn"],
        "96ac6c6976655f64616d61676564010203a16da4746f726e",
    ),
    (
        e.LiveChanged(1, 2, 3, "m", 4),
        ["live_changed", 1, 2, 3, "m", 4],
        "96ac6c6976655f6368616e676564010203a16d04",
    ),
    (e.Beat(1, 2, 3), ["beat", 1, 2, 3], "94a462656174010203"),
]


def kinds(value: object) -> str:
    return type(value).__name__


every_request = pytest.mark.parametrize(
    ("message", "elements", "golden"), [*REQUESTS, *LIVE_REQUESTS], ids=kinds
)
every_reply = pytest.mark.parametrize(("message", "elements", "golden"), [*REPLIES, *LIVE_REPLIES], ids=kinds)


def test_every_message_is_here() -> None:
    assert {type(row[0]) for row in (*REQUESTS, *LIVE_REQUESTS)} == set(get_args(m.Request))
    assert {type(row[0]) for row in (*REPLIES, *LIVE_REPLIES)} == set(get_args(m.Reply))
    assert {type(event) for event, _, _ in EVENTS} == set(get_args(e.Event))


@every_request
def test_requests(message: object, elements: list[Any], golden: str) -> None:
    """Also those of a later minor version, with further elements."""
    data = bytes.fromhex(golden)
    assert encode(message) == pack(elements) == data
    assert unpack(data) == elements
    assert decode_request(data) == message
    assert decode_request(pack([*elements, "something new", [1, {"a": None}]])) == message


@every_reply
def test_replies(message: object, elements: list[Any], golden: str) -> None:
    data = bytes.fromhex(golden)
    assert encode(message) == pack(elements) == data
    assert unpack(data) == elements
    assert decode_reply(data) == message
    assert decode_reply(pack([*elements, "something new"])) == message


@pytest.mark.parametrize(("event", "elements", "golden"), EVENTS, ids=kinds)
def test_events(event: e.Event, elements: list[Any], golden: str) -> None:
    data = bytes.fromhex(golden)
    assert e.encode_event(event) == data == pack(elements)
    assert unpack(data) == elements
    assert e.decode_event(data) == event
    assert e.decode_event(pack([*elements, "something new"])) == event


def test_an_event_of_a_later_version_is_left_out() -> None:
    assert e.decode_event(pack(["danced", 1, 2, 3, "a"])) is None


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x93", pack("text"), pack([1, 2, 3, 4]), pack(["beat"])])
def test_what_is_no_event_is_refused(data: bytes) -> None:
    with pytest.raises(ProtocolMismatch):
        e.decode_event(data)


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


def test_elements_that_a_reply_lacks_have_their_defaults() -> None:
    (elements,) = [elements for message, elements, _ in REPLIES if isinstance(message, m.Cells)]
    reply = decode_reply(pack(elements[:9]))
    assert isinstance(reply, m.Cells)
    assert (reply.layers, reply.covered, reply.reason, reply.next) == ((), True, "", "")


def test_statistics_print_as_one_line() -> None:
    reply = m.StatsReply(7, 3, 5, {f"counter_{n}": n for n in range(100)}, ())
    assert repr(reply) == "<StatsReply of daemon run 0000000000000003: 100 counters, 0 sessions>"
