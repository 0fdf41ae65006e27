# SPDX-License-Identifier: Apache-2.0
"""One copy of a vehicle's point-cloud map per machine, in shared memory.

::

    import shmmap

    cells = shmmap.connect().around(x, y, radius=50)
    print(sum(len(cell.xyz) for cell in cells))

Every public name is loaded when it is first used, so that ``import shmmap`` itself costs next to nothing: it
loads what says why a name cannot be loaded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import shmmap.errors as _errors
from shmmap.lazy_names import lazy_names
from shmmap.optional_packages import needed_packages
from shmmap.segment.process_limits import no_files_left
from shmmap.version import __version__

if TYPE_CHECKING:
    from shmmap.chunks.occupancy import Occupancy, ScanCounts, ScanFilter
    from shmmap.client import (
        Cell,
        CellInfo,
        CellSet,
        Client,
        Departed,
        EventStream,
        MapListing,
        MapWindow,
        Missed,
        PendingLayer,
        PointsAround,
        Retention,
        RetentionPolicy,
        WindowUpdate,
        connect,
    )
    from shmmap.client.live.chunk_reader import ChunkInfo
    from shmmap.client.live.live_map import LiveMap, Sphere, Voxels
    from shmmap.client.live.mapper import LiveMapper
    from shmmap.errors import (
        BadRequest,
        Busy,
        CannotStart,
        CannotWrite,
        CellError,
        ConfigError,
        ConnectionLost,
        DaemonUnreachable,
        InstanceBusy,
        InternalError,
        LimitReached,
        LiveInterrupted,
        LoadFailed,
        LoadTimeout,
        MapDataError,
        MapMissing,
        NoAnswer,
        NoColumn,
        NoSession,
        NoSocket,
        NoSpace,
        NotPermitted,
        Offline,
        OverBudget,
        PackageMissing,
        ProtocolMismatch,
        SegmentCorrupt,
        SegmentError,
        ShmmapError,
        ShmmapWarning,
        SocketPermission,
        StaleHandle,
        StaleSocket,
        UnknownCell,
    )
    from shmmap.formats.cloud import read_cloud
    from shmmap.formats.pcd.writer import write_pcd
    from shmmap.geometry import Area, AutowareSquare, Box, Circle, ZRange
    from shmmap.layers.build import build_layer
    from shmmap.layers.contract import LayerKind, LayerTable
    from shmmap.layers.ground import ground_height
    from shmmap.layers.ndt import voxel_covariances
    from shmmap.layers.spec import canonical_layer
    from shmmap.protocol.live import LiveMapRow
    from shmmap.protocol.messages import HeldCell, Holder, Intent

__all__ = [
    "Area",
    "AutowareSquare",
    "BadRequest",
    "Box",
    "Busy",
    "CannotStart",
    "CannotWrite",
    "Cell",
    "CellError",
    "CellInfo",
    "CellSet",
    "ChunkInfo",
    "Circle",
    "Client",
    "ConfigError",
    "ConnectionLost",
    "DaemonUnreachable",
    "Departed",
    "EventStream",
    "HeldCell",
    "Holder",
    "InstanceBusy",
    "Intent",
    "InternalError",
    "LayerKind",
    "LayerTable",
    "LimitReached",
    "LiveInterrupted",
    "LiveMap",
    "LiveMapRow",
    "LiveMapper",
    "LoadFailed",
    "LoadTimeout",
    "MapDataError",
    "MapListing",
    "MapMissing",
    "MapWindow",
    "Missed",
    "NoAnswer",
    "NoColumn",
    "NoSession",
    "NoSocket",
    "NoSpace",
    "NotPermitted",
    "Occupancy",
    "Offline",
    "OverBudget",
    "PackageMissing",
    "PendingLayer",
    "PointsAround",
    "ProtocolMismatch",
    "Retention",
    "RetentionPolicy",
    "ScanCounts",
    "ScanFilter",
    "SegmentCorrupt",
    "SegmentError",
    "ShmmapError",
    "ShmmapWarning",
    "SocketPermission",
    "Sphere",
    "StaleHandle",
    "StaleSocket",
    "UnknownCell",
    "Voxels",
    "WindowUpdate",
    "ZRange",
    "__version__",
    "build_layer",
    "canonical_layer",
    "connect",
    "ground_height",
    "needed_packages",
    "read_cloud",
    "voxel_covariances",
    "write_pcd",
]

_load = lazy_names(__name__)


def __getattr__(name: str) -> Any:
    if name in _errors.__all__:  # an error can be named where no file can be opened
        return getattr(_errors, name)
    try:
        with needed_packages(f"shmmap.{name}"):
            return _load(name)
    except (OSError, ImportError) as error:
        limit = no_files_left(error, f"shmmap.{name} cannot be loaded: ")
        if limit is None:
            raise
        raise limit from None


def __dir__() -> list[str]:
    return sorted(__all__)
