# SPDX-License-Identifier: Apache-2.0
"""A segment in memory as others see it: a handle in replies, a row of the statistics."""

from __future__ import annotations

import msgspec

from shmmap.daemon.records import Resident
from shmmap.protocol.codec import encode_handle
from shmmap.protocol.messages import Handle
from shmmap.statistics.cell_rows import CellRow

__all__ = ["cell_row", "encode_handles"]


def encode_handles(resident: Resident, wire_id: str, segment: str) -> None:
    """Encode the handle once, fresh and stale, to be used in every reply.

    Parameters
    ----------
    wire_id, segment
        Cell id and segment name, both without their prefixes.
    """
    handle = Handle(
        wire_id,
        resident.version,
        resident.key.layer,
        segment,
        0,
        resident.nbytes,
        resident.points,
        *resident.box,
    )
    resident.handle = encode_handle(handle)
    resident.stale_handle = encode_handle(msgspec.structs.replace(handle, stale=True))


def cell_row(resident: Resident, wire_id: str, segment: str, state: str) -> CellRow:
    """Return the segment's row; names as for `encode_handles`."""
    return CellRow(
        id=wire_id,
        layer=resident.key.layer,
        version=resident.version,
        segment=segment,
        state=state,
        bytes=resident.nbytes,
        points=resident.points,
        box=resident.box,
        hits=resident.hits,
        last_use_monotonic_ns=int(resident.last_use_s * 1e9),
        load_ns=resident.load_ns,
    )
