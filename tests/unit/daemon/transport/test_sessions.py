# SPDX-License-Identifier: Apache-2.0
"""Sessions: what the kernel says of a peer, and sums that stay right whatever is held and dropped."""

from __future__ import annotations

import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.connection import Peer
from shmmap.daemon.transport.sessions import MOVES_PER_STEP, Sessions, command_of
from shmmap.daemon.travel.places import MAX_PER_CLIENT
from shmmap.protocol.messages import Intent
from tests.support import connections
from tests.support.connections import says


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
    """Two segments share each version; what no session has changes nothing."""
    sessions = Sessions()
    clients = [sessions.open(connections.of(), str(n), 0.0) for n in range(3)]
    segments = [resident(n, n // 2 + 1, 10**n) for n in range(8)]
    model: list[set[int]] = [set(), set(), set()]
    for what, index, number in steps:
        client, has, version = clients[index], model[index], number // 2 + 1
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
            assert sorted(r.nbytes for held in session.held.values() for r in held) == sorted(
                10**n for n in numbers
            )
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
    for one in (segment, other_has):
        earlier.drop_segment(one)
    assert (segment.sessions, other_has.sessions) == ({5, other.slot} if shared else {5}, set())
    assert (later.held_bytes, later.exclusive_bytes) == (10, 0 if shared else 10)
    assert (other.held_bytes, other.exclusive_bytes) == (10 if shared else 0, 0)
    later.drop([1])
    assert (segment.sessions, later.exclusive_bytes) == ({other.slot} if shared else set(), 0)
    assert other.exclusive_bytes == (10 if shared else 0)


def test_a_session_and_its_connections() -> None:
    """It can change its connection; what it said of where it is does not count any more then."""
    sessions = Sessions()
    first, second = connections.of(Peer(0, 0, os.getpid())), connections.of(Peer(0, 0, os.getpid()))
    session = sessions.open(first, "x" * 100, 1.0)
    assert session.client == "x" * 64
    assert session.command == command_of(os.getpid()) != ""
    assert (first.slot, sessions.slots.get(session.slot)) == (session.slot, session)
    says(session, Intent(1.0, 2.0), 0.0)
    session.connect(second)
    assert (first.slot, second.slot, session.connection) == (0, session.slot, second)
    sessions.follow_moves()
    assert len(sessions.places()) == 0
    sessions.departed[session.slot] = session
    sessions.close(session)
    assert (second.slot, sessions.slots.get(session.slot), sessions.departed) == (0, None, {})
    sessions.close(session)  # twice does no harm


def test_a_client_s_name_cannot_move_a_terminal_s_cursor() -> None:
    assert Sessions().open(connections.of(), "a\x1b[2Jb\n", 0.0).client == "a\\x1b[2Jb\\n"


def test_a_slot_is_kept_or_new() -> None:
    sessions = Sessions()
    kept = sessions.open(connections.of(), "", 0.0, slot=1234)
    assert kept.slot == 1234
    others = [sessions.open(connections.of(), "", 0.0, slot=slot) for slot in (1234, 0, -1, 1 << 62)]
    assert len({1234, *(other.slot for other in others)}) == 5
    assert all(0 < other.slot < 1 << 62 for other in others)


def test_which_session_ends_when_there_are_too_many() -> None:
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


def test_many_moves_are_followed_a_few_at_a_time() -> None:
    sessions = Sessions()
    for number in range(3 * MOVES_PER_STEP):
        says(sessions.open(connections.of(), "", 0.0), Intent(100.0 * number, 0.0), 0.0)
    for count in (1, 2, 3):
        assert len(sessions.follow_moves()) == MOVES_PER_STEP
        assert len(sessions.places()) == count * MOVES_PER_STEP
    assert sessions.moved == {}
    assert sessions.follow_moves() == []


def places(sessions: Sessions) -> set[tuple[float, float]]:
    """Where clients are or will be."""
    sessions.follow_moves()
    return {(x, y) for x, y, *_ in sessions.places().tolist()}


def test_where_clients_are_going() -> None:
    sessions = Sessions()
    one, other = (sessions.open(connections.of(), "", 0.0) for _ in range(2))
    assert places(sessions) == set()
    says(one, Intent(1.0, 2.0, route=((1.0, 2.0), (101.0, 2.0))), 0.0)
    version = sessions.places_version
    found = places(sessions)
    assert sessions.places_version != version
    assert {(1.0, 2.0), (101.0, 2.0)} < found
    assert {y for _, y in found} == {2.0}, "all along the route"
    assert one.intent is not None
    assert not one.intent.route, "the motion has it; it may be long"
    says(other, Intent(-2.0, 3.0), 0.0)
    assert places(sessions) == found | {(-2.0, 3.0)}
    one.connection.slot = 0
    sessions.close(one)
    assert places(sessions) == {(-2.0, 3.0)}
    other.disconnect()
    assert places(sessions) == set()


def test_a_route_lasts_until_the_client_says_something_else() -> None:
    """A request that says nothing of it changes nothing; one with another pose and no route ends it."""
    sessions = Sessions()
    session = sessions.open(connections.of(), "", 0.0)
    says(session, Intent(0.0, 0.0, route=((0.0, 0.0), (100.0, 0.0))), 0.0)
    sessions.follow_moves()
    sessions.moved[session] = None  # it asks for another area
    assert (100.0, 0.0) in places(sessions)
    says(session, Intent(1.0, 0.0), 1.0)
    assert places(sessions) == {(1.0, 0.0)}


@pytest.mark.parametrize("far", [1e4, 1e9, 1e308])
def test_a_route_of_any_length_counts_as_a_bounded_number_of_places(far: float) -> None:
    """Also where it leaves the map by far."""
    sessions = Sessions()
    route = tuple((far * (1 + n % 3), far * n * (-1) ** n) for n in range(4096))
    for intent in (Intent(0.0, 0.0, route=route), Intent(far, far, vx=-far, vy=far)):
        says(sessions.open(connections.of(), "", 0.0), intent, 0.0)
        sessions.follow_moves()
    assert all(len(session.places) <= MAX_PER_CLIENT for session in sessions)
    assert np.isfinite(sessions.places()[:, :4]).all()
