# SPDX-License-Identifier: Apache-2.0
"""A cell of the map in this process: read-only arrays over shared memory."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from shmmap.errors import NoColumn, ShmmapError
from shmmap.lazy_imports import needed_packages
from shmmap.open3d_loading import load_open3d
from shmmap.protocol.messages import Handle
from shmmap.segment.attach import AttachedSegment, attach_writable
from shmmap.segment.layout import Lattice, SegmentHeader, SourceStamp

if TYPE_CHECKING:
    import open3d
    import torch
    from numpy.typing import NDArray


class Access(NamedTuple):
    """How this process reaches a daemon's segments.

    ``shm_dir`` is their directory.  ``slot`` identifies the session under which the daemon sees them in use.
    ``owner`` is the user id that must own them, or None if it is not known.
    """

    shm_dir: str
    slot: int | None
    owner: int | None


class Cell:
    """An attached cell: one layer at one version.

    Every array is a read-only view of shared memory, zero-copy, and valid as long as it or any
    view of it lives: after the cell object is gone, after the client is closed, after the daemon
    ended.  Its bytes never change; a change of the map produces a new cell.

    A pickled cell contains only its handle, and is attached when it is unpickled.  If the segment is gone by
    then, that raises `StaleHandle` (``MULTIPROCESSING.md``).  The daemon counts it as used by the client that
    the cell came from.  `copy` makes a cell that does not depend on the daemon.

    Attributes
    ----------
    id : str
        Absolute path of the source file, as in Autoware.
    name : str
        The id without the common prefix of all ids of the map, usually the file's name (``"120_40.pcd"``).
        It is meant for people, and is accepted wherever an id is.
    version : int
        Identifies the bytes: a 64-bit hash of the id, the box and the source's state.  For a computed layer
        the hash also covers the computation and its inputs.
    layer : str
        ``"points"`` is the source itself.
    box : tuple of float
        (min_x, min_y, max_x, max_y), metres, map frame.
    points : int
        Number of rows: points, voxels, or occupied columns of a grid over the ground.  Tables over a
        `lattice`, such as those of ``elevation``, (ny, nx), have more elements, also for what is empty.
    stale : bool
        Whether the source had changed, but its new version was not loaded yet, at the last reply that named
        this version.
    segment : str
        Name of the shared-memory object.
    offset, nbytes : int
        Position and size of the cell in the segment, header included, bytes.
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
        self._access = access  # None: the arrays are private memory of this process
        self._views: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        """Return the number of rows, `points`."""
        return self.points

    def __bool__(self) -> bool:
        """Return True, also for a cell without points."""
        return True

    def __repr__(self) -> str:
        rows = "points" if "xyz" in self.column_names else "rows"
        return f"<Cell {self.id} {self.layer} version {self.version_hex}, {self.points} {rows}>"

    def _repr_html_(self) -> str | None:
        """Return a table and a picture for a notebook; None where they cannot be made."""
        try:
            from shmmap.client import notebook  # few programs are notebooks
        except ShmmapError:  # the package was replaced
            return None
        return notebook.cell_html(self)

    # --- copies, and other processes --------------------------------------------------------------

    def copy(self) -> Cell:
        """Return a copy in private memory, which may be written and is pickled with its points.

        The copy has no `segment`, and does not keep the original in the daemon's memory.

        Raises
        ------
        LimitReached
            There is not enough memory.
        """
        return Cell(self.id, "", self.handle(), self._attached.copy(), None)

    def __copy__(self) -> Cell:
        return self if self._access is not None else self.copy()  # immutable: needs no copy

    def __deepcopy__(self, memo: dict[int, Any]) -> Cell:
        return self.__copy__()

    def handle(self) -> Handle:
        """Return the handle by which the cell was attached, with the full name of its segment."""
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

    # --- identity ---------------------------------------------------------------------------

    @property
    def version_hex(self) -> str:
        """The version as 16 hex digits, as in output for people and in JSON."""
        return f"{self.version:016x}"

    # --- columns --------------------------------------------------------------------------------

    def __getitem__(self, column: str) -> NDArray[Any]:
        """Return a column by name: (N,) or (N, k), of a source in its own dtype; ``LAYERS.md`` lists all.

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
        """Coordinates, (N, 3) in the source's dtype (float32 as a rule), metres, relative to `origin`.

        Grids (``elevation``, ``ground``) and ``ndt`` have none.
        """
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
        """Return the SI unit of a column, empty if the source names none; raises as ``cell[column]``."""
        self[column]
        return next(row[5] for row in self._attached.columns if row[0] == column)

    # --- fields of the header -------------------------------------------------------------------

    @property
    def header(self) -> SegmentHeader:
        """The segment's whole header."""
        return self._attached.header

    @property
    def origin(self) -> tuple[float, float, float]:
        """Offset to add to coordinates, metres, map frame; (0, 0, 0) for `points`."""
        return self.header.origin

    @property
    def lattice(self) -> Lattice | None:
        """The lattice on which a computed layer's rows lie; None if the layer has none."""
        return self.header.lattice

    @property
    def z_bounds(self) -> tuple[float, float]:
        """Lowest and highest z, metres, map frame; NaN for an empty cell."""
        return self.header.z_min, self.header.z_max

    @property
    def source_points(self) -> int:
        """Number of points in the source, dropped points included."""
        return self.header.source_points

    @property
    def dropped_points(self) -> int:
        """Number of points left out because a coordinate is not finite."""
        return self.header.dropped_points

    @property
    def source(self) -> SourceStamp:
        """Size (bytes), mtime and ctime (ns) of the source file; other sources: numbers of their state."""
        return self.header.source

    @property
    def source_digest(self) -> bytes:
        """XXH3-128 of the source file, 16 bytes; for other sources, bytes that identify their content."""
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
            A column's bytes changed; the message names the first such column.
        """
        self._attached.verify()

    # --- other libraries ------------------------------------------------------------------------ These
    # libraries do not support read-only memory, so they receive memory that may be written.  DLPack: numpy
    # 2.1 and later export ``cell.xyz`` read-only to consumers that ask for DLPack 1.0, as
    # ``np.from_dlpack(cell.xyz)`` does; older consumers get a BufferError, never a copy.

    def to_open3d(self) -> open3d.t.geometry.PointCloud:
        """Return an Open3D tensor point cloud over a private copy-on-write mapping of the cell.

        ``xyz`` is its ``positions``; every other column is an attribute of its own name, (N, 1) or (N, k).
        Reading copies nothing.  A write copies the page (4 KiB) into private memory and is visible in this
        result alone: the cell, other results and other processes keep their bytes.

        Raises
        ------
        LimitReached
            There is no room for another mapping, and no memory for a copy.
        ShmmapError
            Open3D is not installed, or lacks libraries of the system; the hint names them.
        """
        o3d = load_open3d("to_open3d()")
        cloud: open3d.t.geometry.PointCloud = o3d.t.geometry.PointCloud()
        for name, view in self._writable().items():
            # Open3D wants a row per point, also where a point has one value
            rows = view if view.ndim > 1 else view.reshape(-1, 1)
            cloud.point["positions" if name == "xyz" else name] = o3d.core.Tensor.from_numpy(rows)
        return cloud

    def to_torch(self) -> dict[str, torch.Tensor]:
        """Return torch tensors by column name over a private copy-on-write mapping of the cell.

        As with `to_open3d`, a write is visible in this result alone.  (``torch.from_numpy(cell.xyz)`` would
        use the shared memory itself, where a write kills the process.)

        Raises
        ------
        LimitReached
            There is no room for another mapping, and no memory for a copy.
        """
        with needed_packages("to_torch()"):
            import torch

        return {name: torch.from_numpy(view) for name, view in self._writable().items()}

    def _writable(self) -> Mapping[str, NDArray[Any]]:
        """Return the columns over a private copy-on-write mapping, which no other view or process sees."""
        segment = self._attached
        if self._access is not None:
            segment = attach_writable(segment, self.segment, offset=self.offset, shm_dir=self._access.shm_dir)
        return {row[0]: segment.column(index) for index, row in enumerate(segment.columns)}
