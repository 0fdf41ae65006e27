# SPDX-License-Identifier: Apache-2.0
"""Events, byte by byte, and what becomes of those that a later version sends."""

from __future__ import annotations

from typing import Any, get_args

import pytest

from shmmap.errors import ProtocolMismatch
from shmmap.protocol import events as e
from tests.support.message_pack import pack, unpack

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


def test_every_kind_is_here() -> None:
    assert {type(event) for event, _, _ in EVENTS} == set(get_args(e.Event))


@pytest.mark.parametrize(("event", "elements", "golden"), EVENTS, ids=lambda v: type(v).__name__)
def test_golden_bytes(event: e.Event, elements: list[Any], golden: str) -> None:
    data = bytes.fromhex(golden)
    assert e.encode_event(event) == data == pack(elements)
    assert unpack(data) == elements
    assert e.decode_event(data) == event
    assert e.decode_event(pack([*elements, "something new"])) == event


def test_an_earlier_daemon_says_less() -> None:
    """Before 1.5 nobody said whether a cell was fetched ahead."""
    loaded = e.decode_event(bytes.fromhex("9ca66c6f61646564010203a161a6706f696e747304050607c308"))
    assert loaded == e.Loaded(1, 2, 3, "a", "points", 4, 5, 6, 7, True, 8, ahead=False)


def test_a_kind_of_a_later_version_is_left_out() -> None:
    assert e.decode_event(pack(["danced", 1, 2, 3, "a"])) is None


@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x93", pack("text"), pack([1, 2, 3, 4]), pack(["beat"])])
def test_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(ProtocolMismatch):
        e.decode_event(data)
