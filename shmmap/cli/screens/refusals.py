# SPDX-License-Identifier: Apache-2.0
"""Who fills the memory that a cell needs, for JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shmmap.errors import CellError
    from shmmap.protocol.messages import Holder

__all__ = ["holder_row", "holder_rows"]


def holder_row(holder: Holder) -> dict[str, object]:
    """Return a holder for JSON."""
    return {
        "session": f"{holder.session:016x}",
        "pid": holder.pid,
        "uid": holder.uid,
        "client": holder.client,
        "command": holder.command,
        "cells": holder.cells,
        "bytes": holder.bytes,
    }


def holder_rows(error: CellError) -> list[dict[str, object]]:
    """Return who holds what keeps a cell out of memory, for JSON."""
    return [holder_row(holder) for holder in error.holders]
