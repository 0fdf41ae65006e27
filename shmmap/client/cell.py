# SPDX-License-Identifier: Apache-2.0
"""A cell of the map in this process: read-only arrays over shared memory."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from shmmap.errors import NoColumn
from shmmap.lazy_imports import needed_packages
from shmmap.protocol.messages import Handle
from shmmap.segment.attach import AttachedSegment, attach_writable
from shmmap.segment.layout import Lattice, SegmentHeader, SourceStamp

if TYPE_CHECKING:
    import open3d
    import torch
    from numpy.typing import NDArray

__all__ = ["Access", "Cell"]


class Access(NamedTuple):
    """How this process gets at a daemon's segments.

    ``shm_dir`` is their directory, ``slot`` the session whose use of them the daemon sees, ``owner`` the user
    they must belong to, None where that is not known.
    """

    shm_dir: str
    slot: int | None
    owner: int | None


class Cell:
    """One layer of one cell at one version, attached.

    Every array is a read-only view of shared memory, zero-copy, and valid as long as it or any
    view of it lives: after the cell object is gone, after the client is closed, after the daemon
    ended.  Its bytes never change; a changed map comes as a new cell.

    A pickled cell is its handle, and is attached where it is unpickled; what is gone by then is a
    `StaleHandle` (``MULTIPROCESSING.md``).  `copy` makes a cell that does not depend on the daemon.

    Attributes
    ----------
    id : str
        Absolute path of the source file, as in Autoware.
    name : str
        The id without what the ids of all cells of the map begin with, as a rule the file's name
        (``"120_40.pcd"``): for people to read, and good wherever an id is asked for.
    version : int
        Names the bytes: a 64-bit hash of the id, the box and the source's state, and for computed layers of
        how and from what they are computed.
    layer : str
        ``"points"`` is the source itself.
    box : tuple of float
        (min_x, min_y, max_x, max_y), metres, map frame.
    points : int
        Rows of each column.
    stale : bool
        At the last reply that named this version: its source has changed, but the successor could
        not be loaded yet.
    segment : str
        Name of the shared-memory object.
    offset, nbytes : int
        Where in it the cell lies, header included.
    """

    __slots__ = (
        "__weakref__",
        "_access",
        "_attached",
        "_views",
        "box",
        "id",
        "layer",
        "name",
        "nbytes",
        "offset",
        "points",
        "segment",
        "stale",
        "version",
    )

    def __init__(
        self, cell_id: str, segment: str, handle: Handle, attached: AttachedSegment, access: Access | None
    ) -> None:
        self.id = cell_id
        self.name = handle.id
        self.version = handle.version
        self.layer = handle.layer
        self.box = (handle.min_x, handle.min_y, handle.max_x, handle.max_y)
        self.points = handle.points
        self.stale = handle.stale
        self.segment = segment
        self.offset = handle.offset
        self.nbytes = handle.bytes
        self._attached = attached
        self._access = access  # None: memory of this process
        self._views: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        """Return the number of points, or of rows in a computed layer."""
        return self.points

    def __bool__(self) -> bool:
        """Return True: a cell without points is a cell, too."""
        return True

    def __repr__(self) -> str:
        return f"<Cell {self.id} {self.layer} version {self.version_hex}, {self.points} points>"

    # --- copies, and other processes --------------------------------------------------------------

    def copy(self) -> Cell:
        """Return the cell in memory of this process alone: it may be written, and pickles with its points.

        Such a cell has no `segment`, and keeps nothing in the daemon.

        Raises
        ------
        LimitReached
            There is not so much memory.
        """
        return Cell(self.id, "", self.handle(), self._attached.copy(), None)

    def __copy__(self) -> Cell:
        return self if self._access is not None else self.copy()  # what never changes need not be copied

    def __deepcopy__(self, memo: dict[int, Any]) -> Cell:
        return self.__copy__()

    def handle(self) -> Handle:
        """Return the handle it was attached by, with its whole segment's name."""
        return Handle(
            self.name,
            self.version,
            self.layer,
            self.segment,
            self.offset,
            self.nbytes,
            self.points,
            *self.box,
            self.stale,
        )

    # --- what it is ---------------------------------------------------------------------------

    @property
    def version_hex(self) -> str:
        """The version as 16 hex digits, as people and JSON read it."""
        return f"{self.version:016x}"

    # --- columns --------------------------------------------------------------------------------

    def __getitem__(self, column: str) -> NDArray[Any]:
        """Return a column by name: (N,) or (N, k), in the source's own dtype.

        Raises
        ------
        NoColumn
            The cell has no such column; the hint lists those it has.  Also a `KeyError`.
        """
        view = self._views.get(column)
        if view is None:
            for index, row in enumerate(self._attached.columns):
                if row[0] == column:
                    view = self._views[column] = self._attached.column(index)
                    break
            else:
                raise NoColumn(
                    f"{self.name}: layer {self.layer} has no column {column!r}",
                    hint=f"it has {', '.join(self.column_names)}",
                )
        return view

    @property
    def xyz(self) -> NDArray[Any]:
        """Coordinates, (N, 3) in the source's dtype (float32 as a rule), metres, relative to `origin`."""
        return self["xyz"]

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of the columns, in the source's order."""
        return tuple(row[0] for row in self._attached.columns)

    @property
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """All columns by name."""
        return MappingProxyType({name: self[name] for name in self.column_names})

    def unit(self, column: str) -> str:
        """SI unit of a column, empty where the source names none; errors are those of ``cell[column]``."""
        self[column]
        return next(row[5] for row in self._attached.columns if row[0] == column)

    # --- what the header says -------------------------------------------------------------------

    @property
    def header(self) -> SegmentHeader:
        """All that the segment says about itself."""
        return self._attached.header

    @property
    def origin(self) -> tuple[float, float, float]:
        """What coordinates are relative to, metres, map frame; (0, 0, 0) for `points`."""
        return self.header.origin

    @property
    def lattice(self) -> Lattice | None:
        """The lattice that a computed layer's rows lie on; None where it has none."""
        return self.header.lattice

    @property
    def z_bounds(self) -> tuple[float, float]:
        """Lowest and highest z, metres, map frame; NaN for an empty cell."""
        return self.header.z_min, self.header.z_max

    @property
    def source_points(self) -> int:
        """Points in the source, those that were dropped included."""
        return self.header.source_points

    @property
    def dropped_points(self) -> int:
        """Points left out because a coordinate is not finite."""
        return self.header.dropped_points

    @property
    def source(self) -> SourceStamp:
        """Size (bytes), mtime and ctime (ns) of the source file; of another source what names its state."""
        return self.header.source

    @property
    def source_digest(self) -> bytes:
        """XXH3-128 of the source file, 16 bytes; of no file, what names its content."""
        return self.header.source_digest

    @property
    def frame_id(self) -> str:
        """Name of the map frame."""
        return self.header.frame_id

    def verify(self) -> None:
        """Compare every column with its checksum; needs the ``xxhash`` package.

        The header's own checksum was verified when the cell was attached.

        Raises
        ------
        SegmentCorrupt
            Naming the first column whose bytes changed.
        """
        self._attached.verify()

    # --- other libraries ------------------------------------------------------------------------
    # None of them knows read-only memory: the memory that they are given may be written.  DLPack: numpy 2.1
    # and later export ``cell.xyz`` read-only to consumers that ask for DLPack 1.0, as
    # ``np.from_dlpack(cell.xyz)`` does; older consumers get a BufferError, never a copy.

    def to_open3d(self) -> open3d.t.geometry.PointCloud:
        """Return an Open3D tensor point cloud over the cell's memory, which may be written.

        ``xyz`` is its ``positions``; every other column is an attribute of its own name, (N, 1) or
        (N, k).  Nothing is copied to be read.  What is written becomes memory of this process, 4 KiB at a
        time, and shows in this result alone: the cell, other results and other processes keep their bytes.

        Raises
        ------
        LimitReached
            There is no room for another mapping, and no memory for a copy.
        """
        with needed_packages("to_open3d()"):
            import open3d

        cloud = open3d.t.geometry.PointCloud()
        for name, view in self._writable().items():
            # Open3D wants a row per point, also where a point has one value
            rows = view if view.ndim > 1 else view.reshape(-1, 1)
            cloud.point["positions" if name == "xyz" else name] = open3d.core.Tensor.from_numpy(rows)
        return cloud

    def to_torch(self) -> dict[str, torch.Tensor]:
        """Return torch tensors by column name over the cell's memory, which may be written.

        As for `to_open3d`, what is written shows in this result alone.  (``torch.from_numpy(cell.xyz)`` would
        be over the shared memory itself, where writing ends the process.)

        Raises
        ------
        LimitReached
            There is no room for another mapping, and no memory for a copy.
        """
        with needed_packages("to_torch()"):
            import torch

        return {name: torch.from_numpy(view) for name, view in self._writable().items()}

    def _writable(self) -> Mapping[str, NDArray[Any]]:
        """Return the columns over memory that may be written, which no other view or process sees."""
        segment = self._attached
        if self._access is not None:
            segment = attach_writable(segment, self.segment, offset=self.offset, shm_dir=self._access.shm_dir)
        return {row[0]: segment.column(index) for index, row in enumerate(segment.columns)}
