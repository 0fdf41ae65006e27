# SPDX-License-Identifier: Apache-2.0
"""Groups and names of this machine's users."""

from __future__ import annotations

import grp
import pwd

from shmmap.errors import ConfigError

__all__ = ["account_name", "group_id"]


def account_name(uid: int) -> str:
    """Return a user's name, or the number of one without."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def group_id(name: str, key: str) -> int:
    """Return the id of a group given by name or number; ``key`` is the setting it comes from.

    Raises
    ------
    ConfigError
        There is no such group.
    """
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        if name.isdigit():
            return int(name)
        raise ConfigError(f"there is no group {name!r}", key=key, hint=f"groupadd --system {name}") from None
