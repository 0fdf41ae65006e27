# SPDX-License-Identifier: Apache-2.0
"""Messages between the daemon and its loader workers.

One packet of a SEQPACKET socket pair is one message (MessagePack array, kind first); `Job` also carries the
descriptor of the file that the segment goes into, which has no name.  Both ends are always the same version
of shmmap, so this is no public protocol.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shmmap.layers.sources import Neighbour
from shmmap.segment.version import Source, Stamp

__all__ = [
    "Begun",
    "Check",
    "Checked",
    "Decision",
    "Done",
    "Ended",
    "Failed",
    "FromWorker",
    "Job",
    "Need",
    "Ready",
    "Root",
    "ToWorker",
    "decode_from_worker",
    "decode_to_worker",
    "encode",
]


class Job(msgspec.Struct, array_like=True, tag="job"):
    """Load one layer of one cell; ``granted`` bytes are reserved for it.

    ``points`` names the cell's ``points`` segment where that is in memory: a computed layer need not
    read the source then.  ``neighbours`` are the cells around it, for a layer with a halo; ``ready`` is the
    version of a layer that the origin has ready made, 0 of one that is computed.
    """

    number: int
    cell_id: str
    source: Source
    layer: str
    box: tuple[float, float, float, float]
    frame_id: str
    granted: int
    points: str = ""
    neighbours: tuple[Neighbour, ...] = ()
    ready: int = 0


class Check(msgspec.Struct, array_like=True, tag="check"):
    """Compare a source with ``stamp``, and a segment of an earlier run, if named, with its checksums."""

    number: int
    source: Source
    segment: str
    stamp: Stamp


class Root(msgspec.Struct, array_like=True, tag="root"):
    """Read files below the directory ``path`` through the descriptor that comes with the packet."""

    path: str


class Decision(msgspec.Struct, array_like=True, tag="decision"):
    """Whether the bytes asked for are reserved, or do not fit."""

    granted: bool


class Ready(msgspec.Struct, array_like=True, tag="ready"):
    """The worker has started: from now on its death is its job's fault.

    Its pidfd comes with the packet; ``pid`` is for operators and tests.
    """

    pid: int


class Begun(msgspec.Struct, array_like=True, tag="begun"):
    """What a job needs has been fetched, and the worker works on it from now on.

    Only a worker that fetches for several jobs at once sends it; any other works on its jobs as they came.
    """

    number: int


class Need(msgspec.Struct, array_like=True, tag="need"):
    """The segment needs more than was granted; the worker waits for a `Decision`."""

    number: int
    bytes: int


class Done(msgspec.Struct, array_like=True, tag="done"):
    """The segment is finished, and the worker has closed its own descriptor of it.

    So the daemon can ask the kernel from the first moment on which processes use the segment.
    ``version`` is that of its bytes, ``points`` are the layer's rows, ``z_min`` and ``z_max`` bound the
    source's points; ``neighbours`` are the stamps of the job's, as they were read; ``cached``: it came out of
    the disk cache; ``outside`` points lie outside the cell's box; ``objects``: what the worker has read of a
    published map since its last report (`shmmap.origin.remote.object_tier.ObjectCounts`).
    """

    number: int
    header_bytes: int
    points: int
    dropped: int
    z_min: float
    z_max: float
    version: int
    stamp: Stamp
    load_ns: int
    warnings: tuple[str, ...] = ()
    neighbours: tuple[Stamp, ...] = ()
    cached: bool = False
    outside: int = 0
    objects: tuple[int, ...] = ()


class Checked(msgspec.Struct, array_like=True, tag="checked"):
    """Source and segment are what they should be, or ``wrong`` says why not; the worker has closed both.

    ``stamp`` is the source's state, if it could be looked at.
    """

    number: int
    wrong: str = ""
    stamp: Stamp | None = None


class Failed(msgspec.Struct, array_like=True, tag="failed"):
    """No segment; ``stamp`` is the source's, if it is known; ``unread``: it could not be read.

    ``objects`` as in `Done`.
    """

    number: int
    code: str
    message: str
    stamp: Stamp | None = None
    unread: bool = False
    objects: tuple[int, ...] = ()


class Ended(msgspec.Struct, array_like=True, tag="ended"):
    """The worker's process has ended: its exit code (a signal's number below zero), or why there was none.

    Its parent sends it over the worker's channel, after everything that the worker has sent.
    """

    code: int
    reason: str = ""


ToWorker: TypeAlias = Job | Check | Root | Decision
FromWorker: TypeAlias = Ready | Begun | Need | Done | Checked | Failed | Ended

encode: Final = msgspec.msgpack.Encoder().encode
decode_to_worker: Final = msgspec.msgpack.Decoder[ToWorker](ToWorker).decode
decode_from_worker: Final = msgspec.msgpack.Decoder[FromWorker](FromWorker).decode
