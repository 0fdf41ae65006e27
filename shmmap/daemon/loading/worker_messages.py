# SPDX-License-Identifier: Apache-2.0
"""Messages between the daemon and its loader workers.

Each message is one packet of a SEQPACKET socket pair (MessagePack array, kind first).  A `Job` also carries
the descriptor of the unnamed file that the segment is written to.  Both ends always have the same version of
shmmap, so this is not a public protocol.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shmmap.layers.sources import Neighbour
from shmmap.segment.version import Source, Stamp


class Job(msgspec.Struct, array_like=True, tag="job"):
    """Order to load one layer of one cell; ``granted`` bytes are reserved for it.

    ``points`` names the cell's ``points`` segment if it is in memory: a computed layer then need not read the
    source.  ``neighbours`` are the surrounding cells, for a layer with a halo.  ``ready`` is the version of a
    layer that the origin has ready-made, 0 for one that has to be computed.
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
    """Order to compare a source with ``stamp``, and a previous segment, if named, with its checksums."""

    number: int
    source: Source
    segment: str
    stamp: Stamp


class Prepare(msgspec.Struct, array_like=True, tag="prepare"):
    """Order to compute a job's layer into the disk cache, unless it is there; no segment is made."""

    job: Job

    @property
    def number(self) -> int:
        """Number of the job."""
        return self.job.number

    @property
    def source(self) -> Source:
        """Source of the cell."""
        return self.job.source


class Root(msgspec.Struct, array_like=True, tag="root"):
    """Order to read files below the directory ``path`` through the descriptor sent with the packet."""

    path: str


class Decision(msgspec.Struct, array_like=True, tag="decision"):
    """Answer to a `Need`: whether the requested bytes are reserved, or do not fit."""

    granted: bool


class Ready(msgspec.Struct, array_like=True, tag="ready"):
    """Report that the worker has started: from now on, its death is blamed on its job.

    Its pidfd is sent with the packet; ``pid`` is for operators and tests.
    """

    pid: int


class Begun(msgspec.Struct, array_like=True, tag="begun"):
    """Report that the data of a job has been fetched, and that the worker works on the job from now on.

    Only a worker that fetches for several jobs at a time sends it; any other works on its jobs in order.
    """

    number: int


class Arrived(msgspec.Struct, array_like=True, tag="arrived"):
    """Report bytes that have come from the origin since the last report, and after how long answers began.

    ``fetched`` is the number of a job that needs the origin no more, for which ``fetched_bytes`` have come.
    """

    bytes: int
    delays_s: tuple[float, ...] = ()
    fetched: int = 0
    fetched_bytes: int = 0


class Compiling(msgspec.Struct, array_like=True, tag="compiling"):
    """Report that the worker compiles kernels for its job, once for this version: it takes seconds."""


class Need(msgspec.Struct, array_like=True, tag="need"):
    """Report that the segment needs more than was granted; the worker waits for a `Decision`."""

    number: int
    bytes: int


class Done(msgspec.Struct, array_like=True, tag="done"):
    """Report that the segment is finished, and that the worker has closed its own descriptor of it.

    So the daemon can ask the kernel from the first moment on which processes use the segment.  ``version`` is
    the version of its bytes, ``points`` the number of the layer's rows; ``z_min`` and ``z_max`` bound the
    source's points.  ``neighbours`` are the stamps of the job's neighbours as they were read.  ``cached``:
    the layer came from the disk cache.  ``outside``: number of points outside the cell's box.  ``objects``:
    counts of the worker's reads from a published map since its last report
    (`shmmap.origin.remote.object_tier.ObjectCounts`).
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


class Prepared(msgspec.Struct, array_like=True, tag="prepared"):
    """Report that a layer is in the disk cache: its bytes there, and whether it was computed just now."""

    number: int
    bytes: int
    computed: bool


class Checked(msgspec.Struct, array_like=True, tag="checked"):
    """Report that source and segment are valid, or why not (``wrong``); the worker has closed both.

    ``stamp`` is the source's state, if it could be read.
    """

    number: int
    wrong: str = ""
    stamp: Stamp | None = None


class Failed(msgspec.Struct, array_like=True, tag="failed"):
    """Report that a job failed; ``stamp`` is the source's, if known; ``unread``: it could not be read.

    ``objects`` as in `Done`.
    """

    number: int
    code: str
    message: str
    stamp: Stamp | None = None
    unread: bool = False
    objects: tuple[int, ...] = ()


class Ended(msgspec.Struct, array_like=True, tag="ended"):
    """How the worker's process ended: its exit code (negative signal number), or why it could not start.

    The worker's parent sends it over the worker's channel, after everything that the worker has sent.
    """

    code: int
    reason: str = ""


ToWorker: TypeAlias = Job | Check | Prepare | Root | Decision
FromWorker: TypeAlias = (
    Ready | Begun | Arrived | Compiling | Need | Done | Prepared | Checked | Failed | Ended
)

encode: Final = msgspec.msgpack.Encoder().encode
decode_to_worker: Final = msgspec.msgpack.Decoder[ToWorker](ToWorker).decode
decode_from_worker: Final = msgspec.msgpack.Decoder[FromWorker](FromWorker).decode
