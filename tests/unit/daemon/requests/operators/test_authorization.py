# SPDX-License-Identifier: Apache-2.0
"""Who may administer: root, the daemon's user, members of one group; no claim counts."""

from __future__ import annotations

import os
import pwd

import pytest

from shmmap.daemon.requests.operators.operator_requests import Authorization
from shmmap.daemon.transport.connection import Peer
from shmmap.errors import ConfigError, NotPermitted

ADMINS, OTHERS = 61010, 61011
NO_ACCOUNT = 61999


def test_root_and_the_daemons_own_user() -> None:
    for uid in (0, os.geteuid()):
        assert Authorization().allow(Peer(uid, OTHERS, 1), 0.0)


@pytest.mark.parametrize("peer", [Peer(NO_ACCOUNT, OTHERS, 1), Peer(), Peer(NO_ACCOUNT, -1, 0)])
def test_no_other_account_without_a_group(peer: Peer) -> None:
    with pytest.raises(NotPermitted, match="only root"):
        Authorization().require(peer, 0.0)
    with pytest.raises(NotPermitted, match=f"members of group {ADMINS}"):
        Authorization(str(ADMINS)).require(peer, 0.0)


def test_the_group_of_the_process() -> None:
    assert Authorization(str(ADMINS)).allow(Peer(NO_ACCOUNT, ADMINS, 1), 0.0)


def test_a_peer_whose_user_the_kernel_does_not_name_is_no_member() -> None:
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
