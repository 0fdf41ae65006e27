# SPDX-License-Identifier: Apache-2.0
"""Connections for tests of what stands on them."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

from shmmap.daemon.transport.connection import Connection, Peer

__all__ = ["of"]


def of(peer: Peer | None = None, reply: Callable[[bytes], None] | None = None) -> Connection:
    """Return what a session knows of its connection: whose it is, and where replies go."""
    return cast("Connection", SimpleNamespace(peer=peer or Peer(), slot=0, reply=reply))
