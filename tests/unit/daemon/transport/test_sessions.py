# SPDX-License-Identifier: Apache-2.0
"""Sessions: what the kernel says of a peer, and sums that stay right whatever is held and dropped."""

from __future__ import annotations

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.records import Key, Resident
from shmmap.daemon.requests.cell_requests import note_area
from shmmap.daemon.transport.connection import Peer
from shmmap.daemon.transport.sessions import (
    MOVES_AT_ONCE,
    ROUTE_VERTICES,
    SQUARE_M,
    SQUARES_ORIGIN,
    Session,
    Sessions,
    command_of,
    predicted_path,
    squares_of,
)
from shmmap.geometry import Circle
from shmmap.protocol.messages import Intent
from tests.support import connections


def resident(number: int, version: int, nbytes: int) -> Resident:
    box = (0.0, 0.0, 1.0, 1.0)
    return Resident(f"/{number}", Key(f"/{number}.pcd", "points"), version, nbytes, 0, box, 0.0, 0.0)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["hold", "drop", "segment", "nothing"]), st.integers(0, 2), st.integers(0, 7)
        ),
        max_size=40,
    )
)
def test_sums_stay_right(steps: list[tuple[str, int, int]]) -> None:
    """Two segments share each version; what nobody has changes nothing."""
    sessions = Sessions()
    clients = [sessions.open(connections.of(), str(n), 0.0) for n in range(3)]
    segments = [resident(n, n // 2 + 1, 10**n) for n in range(8)]
    model: list[set[int]] = [set(), set(), set()]
    for what, who, number in steps:
        client, has, version = clients[who], model[who], number // 2 + 1
        if what == "hold":
            client.hold([segments[number], segments[number]])
            has.add(number)
        elif what == "drop":
            dropped = client.drop([version, 99, version])
            assert {s.nbytes for s in dropped} == {10**n for n in has if n // 2 + 1 == version}
            has -= {n for n in has if n // 2 + 1 == version}
        elif what == "segment":
            client.drop_segment(segments[number])
            has.discard(number)
        else:
            assert client.drop([]) == client.drop([12345]) == []
        for session, numbers in zip(clients, model, strict=True):
            assert session.held_bytes == sum(10**n for n in numbers)
            assert {r.nbytes for r in session.residents()} == {10**n for n in numbers}
            assert len(session.residents()) == len(numbers)
            assert set(session.held) == {n // 2 + 1 for n in numbers}
            alone = [n for n in numbers if sum(n in other for other in model) == 1]
            assert session.exclusive_bytes == sum(10**n for n in alone)
        for number, segment in enumerate(segments):
            assert segment.sessions == {
                c.slot for c, has in zip(clients, model, strict=True) if number in has
            }
    for client in clients:
        client.drop(list(client.held))
        sessions.close(client)
    assert len(sessions) == 0
    assert all(not segment.sessions for segment in segments)


@pytest.mark.parametrize("shared", [False, True])
def test_a_later_session_of_the_same_slot_keeps_what_it_has(shared: bool) -> None:
    """What the earlier one had is tidied away after it has ended, and the client may be back by then."""
    sessions = Sessions()
    segment, other_has = resident(1, 1, 10), resident(2, 2, 100)
    other = sessions.open(connections.of(), "", 0.0)
    earlier = sessions.open(connections.of(), "", 0.0, slot=5)
    earlier.hold([segment, other_has])
    if shared:
        other.hold([segment])
    sessions.close(earlier)
    later = sessions.open(connections.of(), "", 0.0, slot=5)
    later.hold([segment])
    for one in earlier.residents():
        earlier.drop_segment(one)
    assert (segment.sessions, other_has.sessions) == ({5, other.slot} if shared else {5}, set())
    assert (later.held_bytes, later.exclusive_bytes) == (10, 0 if shared else 10)
    assert (other.held_bytes, other.exclusive_bytes) == (10 if shared else 0, 0)
    later.drop([1])
    assert (segment.sessions, later.exclusive_bytes) == ({other.slot} if shared else set(), 0)
    assert other.exclusive_bytes == (10 if shared else 0)


def test_a_session_and_its_connections() -> None:
    """It can change its connection, and says nothing of where it is meanwhile."""
    sessions = Sessions()
    first, second = connections.of(Peer(0, 0, os.getpid())), connections.of(Peer(0, 0, os.getpid()))
    session = sessions.open(first, "x" * 100, 1.0)
    assert session.client == "x" * 64
    assert session.command == command_of(os.getpid()) != ""
    assert first.session is sessions.by_slot(session.slot) is session
    note_area(session, Circle(1.0, 2.0, 5.0))
    session.connect(second)
    assert [first.session, second.session] == [None, session]
    assert session.connection is second
    assert sessions.places.squares == {}
    sessions.departed[session.slot] = session
    sessions.close(session)
    assert [second.session, sessions.by_slot(session.slot), sessions.departed] == [None, None, {}]
    sessions.close(session)  # twice does no harm


def test_a_client_s_name_cannot_move_a_terminal_s_cursor() -> None:
    assert Sessions().open(connections.of(), "a\x1b[2Jb\n", 0.0).client == "a\\x1b[2Jb\\n"


def test_a_slot_is_kept_or_new() -> None:
    sessions = Sessions()
    kept = sessions.open(connections.of(), "", 0.0, slot=1234)
    assert kept.slot == 1234
    others = [sessions.open(connections.of(), "", 0.0, slot=slot) for slot in (1234, 0, -1, 1 << 62)]
    assert len({1234, *(other.slot for other in others)}) == 5


def test_slots_are_never_alike() -> None:
    sessions = Sessions()
    opened = [sessions.open(connections.of(), "", 0.0) for n in range(200)]
    assert len({session.slot for session in opened}) == 200
    assert all(0 < session.slot < 1 << 62 for session in opened)
    assert {type(session) for session in sessions} == {Session}


def test_who_gives_way() -> None:
    sessions = Sessions()
    assert sessions.spare() is None
    watched = sessions.open(connections.of(Peer(0, 0, os.getpid())), "", 0.0)
    assert sessions.spare() is None
    busy = sessions.open(connections.of(), "", 9.0)
    idle = sessions.open(connections.of(), "", 3.0)
    assert sessions.spare() is idle
    sessions.close(idle)
    hoarded = [sessions.open(connections.of(Peer(0, 0, os.getpid())), "", float(n)) for n in range(3, 6)]
    assert sessions.spare() is watched  # the process that has most gives its idlest
    for session in (watched, *hoarded):
        sessions.close(session)
    assert sessions.spare() is busy


def move(session: Session, intent: Intent) -> None:
    session.intent = intent
    session.sessions.moved[session] = None


def test_many_moves_are_followed_a_few_at_a_time() -> None:
    sessions = Sessions()
    for number in range(3 * MOVES_AT_ONCE):
        move(sessions.open(connections.of(), "", 0.0), Intent(100.0 * number, 0.0))
    for count in (1, 2, 3):
        sessions.follow_moves()
        assert len(sessions.places.squares) == count * MOVES_AT_ONCE
    assert sessions.moved == {}


def middles(sessions: Sessions) -> set[tuple[float, float]]:
    """Middles of the squares in which clients are or will be."""
    sessions.follow_moves()
    return {
        (
            ((square >> 32) - SQUARES_ORIGIN + 0.5) * SQUARE_M,
            ((square & 0xFFFFFFFF) - SQUARES_ORIGIN + 0.5) * SQUARE_M,
        )
        for square in sessions.places.squares
    }


def test_where_a_client_is() -> None:
    """The middle of what it asks for, until it says so itself."""
    sessions = Sessions()
    session = sessions.open(connections.of(), "", 0.0)
    sessions.open(connections.of(), "", 0.0)
    assert middles(sessions) == set()
    for at, middle in (((1.0, 2.0), (8.0, 8.0)), ((300.0, -4.0), (296.0, -8.0))):
        note_area(session, Circle(*at, 5.0))
        assert middles(sessions) == {middle}
    move(session, Intent(70.0, 8.0))
    session.says_where = True
    note_area(session, Circle(1.0, 1.0, 5.0))
    assert middles(sessions) == {(72.0, 8.0)}


def test_where_a_client_is_going_counts() -> None:
    still = Intent(1.0, 2.0)
    assert predicted_path(still) == [(1.0, 2.0)]
    straight = predicted_path(Intent(1.0, 2.0, vx=10.0, vy=-1.0))
    assert straight == [(1.0, 2.0), *((1.0 + 10.0 * s, 2.0 - s) for s in (1, 2, 3, 4, 5))]
    route = tuple((float(i), 0.0) for i in range(100))
    known = predicted_path(Intent(1.0, 2.0, vx=10.0, route=route[:9]))
    assert known == [(1.0, 2.0), *route[:9]], "all of the route, and nothing that the velocity says"
    assert predicted_path(Intent(1.0, 2.0, route=route)) == [(1.0, 2.0), *route[:ROUTE_VERTICES]]
    assert len(route) > ROUTE_VERTICES


def test_eviction_is_told_where_clients_are_going() -> None:
    """All clients together, each square once; who stays in its square changes nothing."""
    sessions = Sessions()
    one, other = (sessions.open(connections.of(), "", 0.0) for _ in range(2))
    move(one, Intent(1.0, 2.0, route=((60.0, 2.0), (140.0, 2.0))))
    assert middles(sessions) == {(8.0, 8.0), (40.0, 8.0), (72.0, 8.0), (136.0, 8.0)}
    move(other, Intent(2.0, 3.0))
    assert middles(sessions) == {(8.0, 8.0), (40.0, 8.0), (72.0, 8.0), (136.0, 8.0)}
    version = sessions.places.version
    move(other, Intent(3.0, 4.0))
    sessions.follow_moves()
    assert sessions.places.version == version
    one.connection.session = None
    sessions.close(one)
    assert middles(sessions) == {(8.0, 8.0)}
    other.disconnect()
    assert middles(sessions) == set()


@pytest.mark.parametrize("far", [1e4, 1e9, 1e308])
def test_however_long_a_route_is_it_counts_as_a_few_squares(far: float) -> None:
    """The farther ahead, the farther apart; also where it leaves the grid."""
    route = tuple((far * (1 + n % 3), far * n * (-1) ** n) for n in range(ROUTE_VERTICES))
    for intent in (Intent(0.0, 0.0, route=route), Intent(far, far, vx=-far, vy=far)):
        assert len(squares_of(predicted_path(intent))) <= 32
    straight = squares_of([(0.0, 0.0), (1000.0, 0.0)])
    assert sorted((square >> 32) - SQUARES_ORIGIN for square in straight) == [0, 2, 4, 8, 16, 32, 62]
