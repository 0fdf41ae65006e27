# SPDX-License-Identifier: Apache-2.0
"""Names of ROS: which are good, what they are in full, and what DDS calls them (``rmw``'s mangling)."""

from __future__ import annotations

import re
from typing import Final

from shmmap import BadRequest

__all__ = ["node_name", "reply_topic", "request_topic", "resolved", "topic"]

_NAME: Final = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_MOST: Final = 200  # DDS allows 255, with a prefix, a suffix and the parameter services' own part


def resolved(name: str, namespace: str) -> str:
    """Return a name in full: one that does not begin with a slash stands in the namespace.

    Raises
    ------
    BadRequest
        It is no name of a topic or service.
    """
    full = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    if not _NAME.fullmatch(name) or not (namespace == "/" or _NAME.fullmatch(namespace)):
        bad = name if not _NAME.fullmatch(name) else namespace
        raise BadRequest(
            f"{bad!r} is no ROS name",
            hint="use letters, digits and _, parted by /; no part begins with a digit",
        )
    if not full.startswith("/"):
        full = f"/{full}"
    if len(full) > _MOST:
        raise BadRequest(f"{full[:40]}... has {len(full)} characters, of at most {_MOST}")
    return full


def node_name(name: str) -> str:
    """Return the name of a node, if it is one.

    Raises
    ------
    BadRequest
        It has a slash, or is no name.
    """
    if "/" in name or not _NAME.fullmatch(name):
        raise BadRequest(f"{name!r} is no name of a node", hint="use letters, digits and _")
    return name


def topic(name: str) -> str:
    """Return what DDS calls a topic."""
    return f"rt{name}"


def request_topic(name: str) -> str:
    """Return what DDS calls a service's requests."""
    return f"rq{name}Request"


def reply_topic(name: str) -> str:
    """Return what DDS calls a service's replies."""
    return f"rr{name}Reply"
