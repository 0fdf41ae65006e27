# SPDX-License-Identifier: Apache-2.0
"""Who may administer, and what operators ask about very many cells: in parts, each request once."""

from __future__ import annotations

import os
import pwd
import select
from collections.abc import Callable, Iterator
from typing import Any, cast

import pytest

from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.daemon.requests.operators.operator_pins import MAX_PINS, OperatorPins
from shmmap.daemon.requests.operators.operator_requests import Authorization, OperatorRequests
from shmmap.daemon.transport.connection import Peer
from shmmap.errors import BadRequest, ConfigError, NotPermitted, OverBudget, ShmmapError
from shmmap.origin.map_directory import open_map
from shmmap.protocol.messages import Evict, Evicted, Pin, Reload, Reloaded, Unpin
from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon, finish

ADMINS, OTHERS = 61010, 61011
NO_ACCOUNT = 61999


@pytest.mark.parametrize("peer", [Peer(NO_ACCOUNT, OTHERS, 1), Peer(), Peer(NO_ACCOUNT, -1, 0)])
def test_no_other_account_without_a_group(peer: Peer) -> None:
    with pytest.raises(NotPermitted, match="only root"):
        Authorization().require(peer, 0.0)
    with pytest.raises(NotPermitted, match=f"members of group {ADMINS}"):
        Authorization(str(ADMINS)).require(peer, 0.0)


def test_a_peer_whose_user_the_kernel_does_not_report_is_no_member() -> None:
    assert not Authorization(str(ADMINS)).allow(Peer(-1, ADMINS, 0), 0.0)


def test_groups_of_an_account_are_asked_for_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a group file says is played here: a test does not add accounts to the machine."""
    account = next((entry for entry in pwd.getpwall() if entry.pw_uid not in (0, os.geteuid())), None)
    if account is None:
        pytest.skip("this machine has no other account")
    asked: list[tuple[str, int]] = []
    groups = [account.pw_gid, ADMINS]

    def lookup(name: str, gid: int) -> list[int]:
        asked.append((name, gid))
        return groups

    monkeypatch.setattr(os, "getgrouplist", lookup)
    privileges = Authorization(str(ADMINS))
    peer = Peer(account.pw_uid, account.pw_gid, 1)
    assert privileges.allow(peer, 0.0)
    assert privileges.allow(peer, 5.0)
    assert asked == [(account.pw_name, account.pw_gid)]
    groups.remove(ADMINS)
    assert privileges.allow(peer, 9.0)  # remembered
    assert not privileges.allow(peer, 10.5)


def test_a_group_that_does_not_exist() -> None:
    with pytest.raises(ConfigError, match="no group 'nosuchgroup'"):
        Authorization("nosuchgroup")


SIDE = 9
CELLS = SIDE * SIDE


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> DividedMap:
    return make_map(tmp_path_factory.mktemp("large") / "map", columns=SIDE, rows=SIDE, points=5)


class Operator:
    """An operator of a daemon, who may do everything."""

    def __init__(self, one: InnerDaemon) -> None:
        self.one = one
        pins = OperatorPins(one.cache, one.scheduler)
        self.requests = OperatorRequests(one.cache, pins, cast("Reloader", None))

    def begin(self, message: Evict | Pin | Unpin) -> Iterator[None]:
        return self.requests.handle(self.one.session(), message, self.one.now_s())

    def ask(self, message: Evict | Pin | Unpin) -> Any:
        finish(self.begin(message))
        return self.reply_to(message.request)

    def reply_to(self, request: int) -> Any:
        (found,) = [reply for _, reply in self.one.replies if reply.request == request]
        return found


@pytest.fixture
def operator(inner: Inner, made: DividedMap) -> Operator:
    """Return the operator of a daemon that has the whole map in memory."""
    one = inner(str(made.root))
    one.everything()
    return Operator(one)


def test_everything_is_evicted_in_parts(operator: Operator) -> None:
    ledger = operator.one.ledger
    left = [ledger.resident_count for _ in operator.begin(Evict(5))]
    assert left == list(range(CELLS, 0, -1))
    assert ledger.resident_count == 0
    assert operator.reply_to(5) == Evicted(5, CELLS, 0)


def test_what_is_gone_meanwhile_is_not_evicted_again(operator: Operator) -> None:
    first = operator.begin(Evict(5))
    next(first)
    freed = operator.ask(Evict(6)).freed
    finish(first)
    assert operator.reply_to(5).freed + freed == CELLS


def test_named_cells_are_evicted_and_pinned_in_parts(operator: Operator, made: DividedMap) -> None:
    ids = tuple(made.corners)
    assert len(list(operator.begin(Pin(5, (*ids, "nowhere"))))) >= 3 * CELLS
    pinned = operator.reply_to(5)
    assert (len(pinned.cells), pinned.unknown) == (CELLS, ("nowhere",))
    assert operator.ask(Evict(6, ids)) == Evicted(6, 0, 0, (), CELLS)
    assert [cell.id for cell in operator.ask(Unpin(7, ids[:-1])).cells] == [ids[-1]]
    assert operator.ask(Evict(8, ids)) == Evicted(8, CELLS - 1, 0, (), 1)
    assert operator.ask(Unpin(9)).cells == ()
    operator.one.run_until_nothing_waits()


def test_too_many_pins(operator: Operator, made: DividedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    ids = tuple(made.corners)
    with pytest.raises(BadRequest, match="cells in one request"):
        operator.ask(Pin(5, ids * (MAX_PINS // CELLS + 1)))
    monkeypatch.setattr(f"{OperatorPins.__module__}.MAX_PINS", 40)
    operator.ask(Pin(6, ids[:40]))
    with pytest.raises(BadRequest, match="more than 40 cells would be pinned"):
        operator.ask(Pin(7, ids[40:41]))
    operator.ask(Pin(8, ids[:1]))  # it is already
    operator.ask(Unpin(9))
    assert len(operator.ask(Pin(10, ids[40:80])).cells) == 40


def test_pins_stay_within_the_budget(operator: Operator, made: DividedMap) -> None:
    """What is pinned cannot be evicted: with all pins together nothing else would have room."""
    ids, ledger = tuple(made.corners), operator.one.ledger
    operator.ask(Pin(5, ids[:2]))
    pinned = sum(resident.nbytes for resident in ledger.residents() if resident.key.cell_id in ids[:2])
    ledger.budget_bytes = pinned + ledger.overhead_bytes
    with pytest.raises(OverBudget, match="would be pinned; the budget is"):
        operator.ask(Pin(6, ids[2:3]))
    assert [cell.id for cell in operator.ask(Pin(7)).cells] == list(ids[:2])


def test_a_repeated_request_is_one(inner: Callable[..., InnerDaemon], small_map: DividedMap) -> None:
    one = inner(small_map.root)
    reloader = Reloader(open_map(str(small_map.root)), lambda: one.cache.catalogue)
    operators = OperatorRequests(one.cache, OperatorPins(one.cache, one.scheduler), reloader)
    session = one.session()
    read: list[Reread] = []
    failed: list[ShmmapError] = []
    for number in (7, 7, 7, 8):
        finish(operators.handle(session, Reload(number), 0.0))

    def apply(found: Reread) -> Reread:
        read.append(found)
        return found

    def collect() -> None:
        assert select.select([reloader.fd], [], [], 30.0)[0]
        reloader.collect(apply, failed.append)

    collect()
    assert [(type(reply), reply.request) for _, reply in one.replies] == [(Reloaded, 7)]
    finish(operators.handle(session, Reload(7), 0.0))  # answered: this is another one
    collect()
    collect()
    assert [reply.request for _, reply in one.replies] == [7, 8, 7]
    assert (len(read), failed) == (3, [])
    reloader.close()
