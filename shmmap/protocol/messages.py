# SPDX-License-Identifier: Apache-2.0
"""Every message between client and daemon, under one roof.  ``PROTOCOL.md`` is the byte-exact document.

A message is one MessagePack array whose first element is its kind and whose second is the request
id that the client chose and the reply repeats.  Arrays may grow at the end: a receiver ignores
elements it does not know and assumes the default for those it misses.
"""

from __future__ import annotations

from typing import Final

from shmmap.protocol.areas import (
    AreaMessage,
    BoxMessage,
    CircleMessage,
    HeldCell,
    Intent,
    SquareMessage,
    area_from_message,
    area_to_message,
)
from shmmap.protocol.replies import (
    Cells,
    ErrorReply,
    Evicted,
    FailedCell,
    Handle,
    MetadataPage,
    MetadataRow,
    PendingCell,
    Pinned,
    PinnedCell,
    Released,
    Reloaded,
    Reply,
    ShownCell,
    StatsReply,
    Stopping,
    Welcome,
)
from shmmap.protocol.requests import (
    Area,
    Bye,
    Differential,
    Evict,
    Hello,
    Metadata,
    Pin,
    Release,
    Reload,
    Request,
    Selected,
    Show,
    Shutdown,
    Stats,
    Unpin,
)
from shmmap.protocol.rows import CellRow, ClientRow, Holder, Window

__all__ = [
    "PROTOCOL_VERSION",
    "Area",
    "AreaMessage",
    "BoxMessage",
    "Bye",
    "CellRow",
    "Cells",
    "CircleMessage",
    "ClientRow",
    "Differential",
    "ErrorReply",
    "Evict",
    "Evicted",
    "FailedCell",
    "Handle",
    "HeldCell",
    "Hello",
    "Holder",
    "Intent",
    "Metadata",
    "MetadataPage",
    "MetadataRow",
    "PendingCell",
    "Pin",
    "Pinned",
    "PinnedCell",
    "Release",
    "Released",
    "Reload",
    "Reloaded",
    "Reply",
    "Request",
    "Selected",
    "Show",
    "ShownCell",
    "Shutdown",
    "SquareMessage",
    "Stats",
    "StatsReply",
    "Stopping",
    "Unpin",
    "Welcome",
    "Window",
    "area_from_message",
    "area_to_message",
]

PROTOCOL_VERSION: Final = (2, 0)
