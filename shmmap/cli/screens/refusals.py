# SPDX-License-Identifier: Apache-2.0
"""Cells that could not be had, for a reader: one line for each cause, and who fills the memory."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from shmmap.errors import UnknownCell
from shmmap.quantities import counted, format_bytes

if TYPE_CHECKING:
    from shmmap.errors import CellError
    from shmmap.protocol.messages import Holder

__all__ = ["NOT_COVERED", "failure_lines", "holder_row", "holder_rows", "unknown_ids"]

NOT_COVERED: Final = "the daemon does not know yet all that the map has there"
_NAMED_CELLS: Final = 3


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


def failure_lines(failed: Iterable[CellError]) -> list[str]:
    """Return one line for each cause, and below it what to do and who uses the memory."""
    causes: dict[tuple[str, str, str], list[CellError]] = {}
    for error in failed:
        # a file's message begins with its path, which the cell's id is
        reason = error.message.removeprefix(_named(error)).removeprefix(f"{error.cell_id}: ")
        causes.setdefault((error.code, error.layer, reason), []).append(error)
    lines = []
    for (code, layer, reason), errors in causes.items():
        if len(errors) == 1:
            named = _named(errors[0]) if errors[0].message.startswith(_named(errors[0])) else ""
            lines.append(f"failed: {named}{reason} [{code}]")
        else:
            names = [error.cell_id.rpartition("/")[2] for error in errors]
            more = ", ..." if len(names) > _NAMED_CELLS else ""
            shown = ", ".join(names[:_NAMED_CELLS]) + more
            lines.append(f"failed: {len(errors):,} cells ({layer}): {reason} [{code}]: {shown}")
        lines += [f"  {errors[0].hint}"] if errors[0].hint else []
        lines += _holder_lines(errors)
    return lines


def unknown_ids(failed: Iterable[CellError]) -> list[str]:
    """Return the ids that the map does not have, each once."""
    return list(dict.fromkeys(error.cell_id for error in failed if error.code == UnknownCell.code))


def _named(error: CellError) -> str:
    return f"{error.cell_id} ({error.layer}): "


def _holder_lines(errors: Iterable[CellError]) -> list[str]:
    """Who uses memory, the most first; each cell's failure tells it again."""
    most: dict[int, Holder] = {}
    for error in errors:
        for holder in error.holders:
            known = most.get(holder.session)
            if holder.bytes and (known is None or known.bytes < holder.bytes):
                most[holder.session] = holder
    ranked = sorted(most.values(), key=lambda holder: -holder.bytes)
    return [
        f"  in use: {format_bytes(one.bytes)} in {counted(one.cells, 'cell')} by {_who(one)}"
        for one in ranked
    ]


def _who(holder: Holder) -> str:
    if not holder.session:
        return "a process that did not open them through the client library"
    return f"{holder.client or holder.command or 'a client'}, pid {holder.pid or '?'}"
