# SPDX-License-Identifier: Apache-2.0
"""Names of user accounts, as ``ls -l`` shows them."""

from __future__ import annotations

__all__ = ["user_name"]


def user_name(uid: int) -> str:
    """Return the name of a user id; the number where there is none, ``?`` where it is not known."""
    import pwd

    if uid < 0:
        return "?"
    try:
        return pwd.getpwuid(uid).pw_name
    except (KeyError, OverflowError):
        return str(uid)
