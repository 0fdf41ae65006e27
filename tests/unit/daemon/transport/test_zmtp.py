# SPDX-License-Identifier: Apache-2.0
"""Bytes become messages, however they are cut into pieces; what is no ZMTP is refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.transport.zmtp import GREETING, Incoming, framed
from shmmap.errors import BadRequest, ProtocolMismatch

LONGEST = 1000
READY = framed(b"\x05READY\x0bSocket-Type\0\0\0\x06DEALER\x08Identity\0\0\0\0", 4)
MORE = 1


class Receiver:
    """One end of a connection."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.incoming = Incoming(b"ROUTER", b"DEALER", LONGEST)

    def receive(self, *pieces: bytes, at_once: int = 1000) -> list[tuple[bytes, bool]]:
        received = []
        for piece in pieces:
            self.incoming.add(piece)
            received += self.incoming.messages(at_once, self.sent.append)
        return received


def wire(frames: list[bytes]) -> bytes:
    """One message of these frames."""
    return b"".join(framed(body, MORE) for body in frames[:-1]) + framed(frames[-1])


@given(
    st.lists(st.lists(st.binary(max_size=300), min_size=1, max_size=3), max_size=6),
    st.lists(st.integers(0, 2000), max_size=12),
    st.integers(1, 5),
)
def test_any_pieces(messages: list[list[bytes]], cuts: list[int], at_once: int) -> None:
    data = GREETING + READY + b"".join(map(wire, messages))
    ends = sorted(min(cut, len(data)) for cut in cuts)
    receiver = Receiver()
    received = receiver.receive(
        *(data[a:b] for a, b in zip([0, *ends], [*ends, len(data)], strict=True)), at_once=at_once
    )
    while receiver.incoming.more:
        received += receiver.incoming.messages(at_once, receiver.sent.append)
    assert received == [(frames[0], len(frames) > 1) for frames in messages]
    assert len(receiver.incoming) == 0


def test_what_the_daemon_sends() -> None:
    """Its type, after the greeting; and a PONG, when asked."""
    receiver = Receiver()
    assert receiver.receive(GREETING[:-1]) == []
    assert receiver.sent == []
    receiver.receive(GREETING[-1:], READY, framed(b"\x04PING\x00\x05abc", 4))
    own = framed(b"\x05READY\x0bSocket-Type\0\0\0\x06ROUTER\x08Identity\0\0\0\0", 4)
    assert receiver.sent == [own, framed(b"\x04PONGabc", 4)]


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n" + bytes(64),
        GREETING[:10] + b"\x02" + GREETING[11:],
        GREETING.replace(b"NULL", b"PLAI"),
        GREETING + framed(b"early"),
        GREETING + READY.replace(b"DEALER", b"ROUTER"),
        GREETING + READY + framed(b"a", MORE) + framed(b"\x04PING\0\0", 4),
    ],
)
def test_what_is_no_client(data: bytes) -> None:
    with pytest.raises(ProtocolMismatch):
        Receiver().receive(data)


@pytest.mark.parametrize(
    "data",
    [
        framed(bytes(LONGEST)),
        framed(bytes(LONGEST))[:9],
        b"\x02" + b"\xff" * 8,
        framed(bytes(400), MORE) * 3,
        framed(b"", MORE) * LONGEST,
        framed(bytes(LONGEST), 4),
    ],
)
def test_a_message_that_is_too_long(data: bytes) -> None:
    """It is known from its head; frames without end are one message."""
    receiver = Receiver()
    with pytest.raises(BadRequest, match="more than 1000 bytes"):
        receiver.receive(GREETING + READY + data, at_once=2 * LONGEST)


def test_work_at_once_is_bounded() -> None:
    receiver = Receiver()
    received = receiver.receive(GREETING + READY + framed(b"a") * 40, at_once=16)
    assert (len(received), receiver.incoming.more) == (15, True)
    assert (len(receiver.incoming.messages(16, receiver.sent.append)), receiver.incoming.more) == (16, True)
    assert (len(receiver.incoming.messages(16, receiver.sent.append)), receiver.incoming.more) == (9, False)


@given(st.binary(max_size=300))
def test_any_bytes(data: bytes) -> None:
    """Messages, one of the two errors, or silence."""
    for start in (b"", GREETING, GREETING + READY):
        receiver = Receiver()
        try:
            receiver.receive(start + data)
        except (ProtocolMismatch, BadRequest):
            continue
        assert len(receiver.incoming) <= len(start + data)
