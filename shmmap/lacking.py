# SPDX-License-Identifier: Apache-2.0
"""Describe what is missing in an answer, for the command line and for warnings.

That is cells that failed, are being loaded, or are empty, and areas where the map has no cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

from shmmap.errors import LoadTimeout, Offline, ShmmapError, UnknownCell, warn_program
from shmmap.quantities import counted, format_bytes, format_metres

if TYPE_CHECKING:
    from shmmap.client.cell_set import CellSet, PendingLayer
    from shmmap.client.client import Client
    from shmmap.errors import CellError
    from shmmap.geometry import Area
    from shmmap.protocol.live import LackingChunk
    from shmmap.protocol.messages import Holder, Welcome

_NOT_COVERED: Final = "the daemon does not know yet all that the map has there"
_OUT_OF_REACH: Final = "the list of cells there cannot be reached at present"
_WAIT_LONGER: Final = "ask again, or wait longer: wait=SECONDS"
PREPARE_HINT: Final = "`shmmap prepare` or the setting prepare computes layers ahead of time"
_NAMED_CELLS: Final = 3
_NAMED_CHUNKS: Final = 5
_MAX_CELLS: Final = 20_000  # searching them for similar ids takes at most a second
_MAX_LINES: Final = 10  # of a warning

_Bounds = tuple[float, float, float, float]


def verdict(
    client: Client, found: CellSet, area: Area | None, *, waited: bool, strict: bool, new: bool = True
) -> str:
    """Return what a `ShmmapWarning` should say of an answer's missing cells, if anything; or raise an error.

    Parameters
    ----------
    client
        Client that received the answer.
    area
        The requested area; None for a request by ids.
    waited
        Whether the daemon had time to load; without it, pending cells are expected and not reported.
    strict
        Raise an error instead of a warning.
    new
        Whether all cells were requested; False: only those that are not held.

    Raises
    ------
    CellError
        A cell failed, is still pending (`LoadTimeout`), or does not exist (`UnknownCell`).
    """
    if strict:
        if (error := _error_of(client, found, area, new)) is not None:
            raise error
        return ""
    lines = failure_lines(found.failed)
    if waited:
        lines += pending_lines(found.pending)
    if not found.covered:
        lines.append("{} ({})".format(*not_covered(found)))
    if unknown := unknown_ids(found.failed):
        lines.append(f"hint: {near_cells_hint(client, unknown)}")
    if found.complete and new:
        nothing = _nothing(client, found, area)
        lines += [f"{message} ({hint})" if hint else message for message, hint in nothing]
    if not lines:
        return ""
    if len(lines) > _MAX_LINES:
        lines[_MAX_LINES:] = [f"... and {len(lines) - _MAX_LINES} more"]
    if found.pending and waited:
        lines.append(f"hint: what is pending is still being loaded: {_wait_longer(found.pending)}")
    if found.failed or (found.pending and waited):
        lines.insert(0, f"{len({cell.id for cell in found}):,} of {_asked(found):,} cells are there:")
    return "\n".join(lines)


def warn_of_lost_chunks(name: str, lacking: Sequence[LackingChunk], count: int) -> None:
    """Warn, at the program's call, that a live map has lost something of ``count`` chunks, named or not."""
    if not count:
        return
    lines = [f"live map {name}: something that was saved is lost of {counted(count, 'chunk')}:"]
    lines += [f"{'_'.join(map(str, one.key))}: {one.reason}" for one in lacking[:_NAMED_CHUNKS]]
    if count > _NAMED_CHUNKS:
        lines.append(f"... and {count - _NAMED_CHUNKS:,} more")
    lines.append("hint: `shmmap live ls` names the files; `shmmap live fsck --repair` forgets what is lost")
    warn_program("\n".join(lines))


def not_covered(found: CellSet) -> tuple[str, str]:
    """Return why an answer may lack cells of the map, and a hint."""
    return _OUT_OF_REACH if found.reason else _NOT_COVERED, "ask again later"


def _error_of(client: Client, found: CellSet, area: Area | None, new: bool) -> ShmmapError | None:
    if found.failed:
        return found.failed[0]
    if found.pending:
        first, more = found.pending[0], len(found.pending) - 1
        return LoadTimeout(
            f"{first.id} ({first.layer}): still being loaded" + (f", and {more} more" if more else ""),
            cell_id=first.id,
            layer=first.layer,
            hint=_wait_longer(found.pending),
        )
    if not found.covered:
        message, hint = not_covered(found)
        return Offline(message) if found.reason else LoadTimeout(message, hint=hint)
    nothing = _nothing(client, found, area) if new else []
    return next((UnknownCell(message, hint=hint) for message, hint in nothing), None)


def _nothing(client: Client, found: CellSet, area: Area | None) -> list[tuple[str, str]]:
    """Return the message and hint for a complete answer without cells."""
    if not found.cells:
        return [no_cell_there(client.welcome, area)] if area is not None else []
    empty = empty_layers(found)
    return [(empty, "")] if empty else []


def empty_layers(found: CellSet) -> str:
    """Return a text about layers that have no points in any cell; empty if all have some."""
    rows: dict[str, int] = {}
    for cell in found.cells:
        rows[cell.layer] = rows.get(cell.layer, 0) + cell.points
    empty = [layer for layer, points in rows.items() if not points]
    cells = counted(len({cell.id for cell in found.cells}), "cell")
    return f"{', '.join(empty)}: no points in {cells}" if empty else ""


def _asked(found: CellSet) -> int:
    ids = {cell.id for cell in found}
    ids.update(cell.id for cell in found.pending)
    ids.update(error.cell_id for error in found.failed)
    return len(ids)


def _wait_longer(pending: Iterable[PendingLayer]) -> str:
    """Return what to do about layers that are still being loaded."""
    computed = any(one.layer != "points" for one in pending)
    return f"{_WAIT_LONGER}; {PREPARE_HINT}" if computed else _WAIT_LONGER


# --- failed and pending -------------------------------------------------------------------------------


def pending_lines(pending: Iterable[PendingLayer]) -> list[str]:
    """Return one line for each layer of a cell that is still being loaded."""
    return [f"pending: {one.id} ({one.layer})" for one in pending]


def failure_lines(failed: Iterable[CellError]) -> list[str]:
    """Return one line per cause, followed by the remedy and the users of the memory."""
    causes: dict[tuple[str, str, str], list[CellError]] = {}
    for error in failed:
        # a file's message begins with its path, which is the cell's id
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
    """Describe the users of memory, largest first, each once although every failed cell lists them."""
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


# --- answers without cells ---------------------------------------------------------------------------


def area_text(area: Area) -> str:
    """Return an area as a sentence names it: ``"within 40 m of (10, 20)"``."""
    from shmmap.geometry import Box, Circle

    if isinstance(area, Box):
        text = f"in {extent_text(area.bounds)}"
    elif isinstance(area, Circle):
        text = f"within {format_metres(area.radius)} m of ({format_metres(area.x)}, {format_metres(area.y)})"
    else:
        centre = f"({format_metres(area.x)}, {format_metres(area.y)})"
        text = f"in the square of half-side {format_metres(area.radius)} m about {centre}"
    if area.z is not None:
        text += f", z {format_metres(area.z[0])} .. {format_metres(area.z[1])} m"
    return text


def extent_text(box: _Bounds) -> str:
    """Return a rectangle: ``"x -60 .. 60 m, y -60 .. 60 m"``."""
    min_x, min_y, max_x, max_y = map(format_metres, box)
    return f"x {min_x} .. {max_x} m, y {min_y} .. {max_y} m"


def no_cell_there(welcome: Welcome, area: Area) -> tuple[str, str]:
    """Return the message that no cell touches an area, with the map's extent, and a hint."""
    spans = f"the map spans {extent_text(welcome.bounds)}" if welcome.bounds else "the map has no cells"
    hint = ""
    if any(welcome.origin):
        x, y, z = map(format_metres, welcome.origin)
        hint = (
            "`divide` shifted the points close to the origin: subtract"
            f" ({x}, {y}, {z}) from coordinates of the cloud"
        )
    return f"no cell {area_text(area)}; {spans}", hint


def near_cells_hint(client: Client, unknown: Sequence[str]) -> str:
    """Return a hint for unknown ids: similar ids, or how to list ids."""
    import difflib  # one millisecond, after a misspelling only

    if not unknown:
        return ""
    few = client.welcome.cells <= _MAX_CELLS
    names = [cell.id.rpartition("/")[2] for cell in client.metadata()] if few else []
    near: dict[str, None] = {}
    for one in unknown[:3]:
        near.update(dict.fromkeys(difflib.get_close_matches(one.rpartition("/")[2], names, n=1, cutoff=0.8)))
    if near:
        return f"did you mean {', '.join(near)}?"
    return "`shmmap query --circle X,Y,R` prints the ids of the cells around a place"
