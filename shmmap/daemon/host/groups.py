# SPDX-License-Identifier: Apache-2.0
"""Groups of this machine's users."""

from __future__ import annotations

import grp

from shmmap.errors import ConfigError

__all__ = ["group_id"]


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
