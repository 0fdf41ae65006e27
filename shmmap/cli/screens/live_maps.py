# SPDX-License-Identifier: Apache-2.0
"""What ``status`` and ``top`` say of live maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from shmmap.cli.screens.output import counted, format_bytes

if TYPE_CHECKING:
    from shmmap.protocol.rows import LiveMapRow

__all__ = ["STATE_STYLES", "live_as_json", "live_problems", "status_lines"]

STATE_STYLES: Final = {
    "loading": "bright_black",
    "clean": "green",
    "dirty": "blue",
    "saving": "cyan",
}
"""Colours of chunks by state, as Rolling-Bonxai has them."""


def live_as_json(row: LiveMapRow) -> dict[str, object]:
    """Return all that is known of a live map, for programs."""
    import msgspec

    return msgspec.structs.asdict(row)


def live_problems(row: LiveMapRow) -> list[str]:
    """What is wrong with a live map, a line each."""
    found = [row.problem] if row.problem else []
    if row.damaged_count:
        found.append(f"damaged files, missing chunks: {row.damaged_count:,}; `shmmap live ls` names them")
    return found


def status_lines(rows: Sequence[LiveMapRow], restarts: int) -> list[tuple[str, str]]:
    """Return the lines of ``status``: one for each map, and what is wrong; none where there are no maps."""
    lines = []
    for row in rows:
        unsaved = f"{row.unsaved:,} not saved" if row.unsaved else "all saved"
        memory = f"{format_bytes(row.bytes)} of {format_bytes(row.budget_bytes)}"
        known = counted(row.active, "known voxel")
        lines.append((f"live {row.name}", f"{counted(row.chunks, 'chunk')}, {memory}, {known}, {unsaved}"))
        lines += [("", problem) for problem in live_problems(row)]
    if restarts:
        often = counted(restarts, "time")
        lines.append(("", f"the process that keeps live maps ended {often}: see the daemon's log"))
    return lines
