# SPDX-License-Identifier: Apache-2.0
"""Permission to change what the daemon serves: reload, evict, pin, shut down.

Judged by what the kernel says of the peer (`Peer`), never of anything a client says.  Root and the
daemon's own user always may; so may members of the configured administrators' group.
"""

from __future__ import annotations

import os
import pwd
from typing import Final

from shmmap.daemon.prerequisites import group_id
from shmmap.daemon.transport.connection import Peer
from shmmap.errors import NotPermitted

__all__ = ["Authorization"]

MEMORY_S: Final = 10.0
"""How long a user's groups are remembered: asking may mean asking a server far away."""


class Authorization:
    """Decides which users may administer the daemon.

    Parameters
    ----------
    group
        Group (name or number) whose members may, besides root and the daemon's user; empty: no one else.
    setting
        Where that is set.

    Attributes
    ----------
    gid
        Number of the group; -1 for none.

    Raises
    ------
    ConfigError
        There is no such group.
    """

    def __init__(self, group: str = "", setting: str = "admin_group") -> None:
        self._name = group
        self.gid = group_id(group, setting) if group else -1
        self._groups: dict[int, tuple[float, frozenset[int]]] = {}

    def allow(self, peer: Peer, now_s: float) -> bool:
        """Whether a connected process may administer the daemon."""
        if peer.uid in (0, os.geteuid()):
            return True
        if self.gid < 0 or peer.uid < 0:
            return False
        return peer.gid == self.gid or self.gid in self._groups_of(peer.uid, now_s)

    def require(self, peer: Peer, now_s: float) -> None:
        """Refuse a process that may not.

        Raises
        ------
        NotPermitted
            It may not.
        """
        if not self.allow(peer, now_s):
            members = f", and members of group {self._name}" if self._name else ""
            raise NotPermitted(
                f"only root and the daemon's own user{members} may do this", hint="run it with sudo"
            )

    def _groups_of(self, uid: int, now_s: float) -> frozenset[int]:
        known = self._groups.get(uid)
        if known is not None and now_s < known[0]:
            return known[1]
        try:
            account = pwd.getpwuid(uid)
            groups = frozenset(os.getgrouplist(account.pw_name, account.pw_gid))
        except (KeyError, OSError):
            groups = frozenset()  # a user this machine has no account of: only its own group counts
        if len(self._groups) >= 1024:
            self._groups.clear()
        self._groups[uid] = (now_s + MEMORY_S, groups)
        return groups
