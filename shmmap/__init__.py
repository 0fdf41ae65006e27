# SPDX-License-Identifier: Apache-2.0
"""One copy of a vehicle's point-cloud map per machine, in shared memory, for every process.

First `connect` to the daemon; ask the `Client` for an area, a `Circle` or a `Box`, and read the points of
each `Cell`; or follow a vehicle with a `MapWindow`:

::

    import shmmap

    with shmmap.connect() as client:
        cells = client.around(x, y, radius=50)  # metres, map frame
        print(sum(len(cell) for cell in cells), "points, the first ones at", cells[0].xyz[:3])

Ask
    ========================  ==================================================================
    `connect`, `Client`       a session with the daemon: `around`, `area`, `selected`, `differential`
    `Circle`, `Box`           areas; `AutowareSquare` is Autoware's area test; `Area` any of them
    `Cell`, `CellSet`         a cell: columns over shared memory; the cells that answer a request
    `PendingLayer`            a layer of a `CellSet` that is still being loaded
    `PointsAround`            the points in a circle, as views of the cells that they lie in
    `MapListing`, `CellInfo`  the cells that the map has, loaded or not
    ========================  ==================================================================

Follow
    ========================  ==================================================================
    `MapWindow`               the cells around a moving pose, kept current by a thread
    `WindowUpdate`            the changes after a move
    `Retention`               which cells outside a window stay attached; a custom policy is a
                              `RetentionPolicy`, which decides about each `RetentionCandidate`
    ========================  ==================================================================

Files
    ========================  ==================================================================
    `read_cloud`              read a cloud file of any format: columns by name
    `write_pcd`               write columns, or an array of points, as a PCD file
    ========================  ==================================================================

Errors
    Every error is a `ShmmapError`: `BadRequest` (an argument is invalid), `DaemonUnreachable` and
    `NoAnswer`, `CellError` (`UnknownCell`, `LoadFailed`, `LoadTimeout`, `Offline`), `StaleHandle`,
    `LimitReached`, `NotPermitted`, `MapDataError`; the whole tree is `shmmap.errors`.  An incomplete result
    is a `ShmmapWarning`.

More
    `shmmap.layers` (layers without a daemon, custom kinds), `shmmap.live` (live maps),
    `shmmap.events` (events of the daemon), `shmmap.aio` (a client for asyncio), `shmmap.testing` (a daemon
    for tests).

Every name is loaded at its first use, so that ``import shmmap`` itself takes almost no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

from shmmap.errors import BadRequest as BadRequest
from shmmap.errors import CellError as CellError
from shmmap.errors import DaemonUnreachable as DaemonUnreachable
from shmmap.errors import LimitReached as LimitReached
from shmmap.errors import LoadFailed as LoadFailed
from shmmap.errors import LoadTimeout as LoadTimeout
from shmmap.errors import MapDataError as MapDataError
from shmmap.errors import NoAnswer as NoAnswer
from shmmap.errors import NotPermitted as NotPermitted
from shmmap.errors import Offline as Offline
from shmmap.errors import ShmmapError as ShmmapError
from shmmap.errors import ShmmapWarning as ShmmapWarning
from shmmap.errors import StaleHandle as StaleHandle
from shmmap.errors import UnknownCell as UnknownCell
from shmmap.lazy_imports import lazy_public_names, public_names
from shmmap.version import __version__ as __version__

if TYPE_CHECKING:  # the list of public names
    from shmmap import events as events
    from shmmap import layers as layers
    from shmmap import live as live
    from shmmap.client import Cell as Cell
    from shmmap.client import CellInfo as CellInfo
    from shmmap.client import CellSet as CellSet
    from shmmap.client import Client as Client
    from shmmap.client import MapListing as MapListing
    from shmmap.client import MapWindow as MapWindow
    from shmmap.client import PendingLayer as PendingLayer
    from shmmap.client import PointsAround as PointsAround
    from shmmap.client import Retention as Retention
    from shmmap.client import RetentionCandidate as RetentionCandidate
    from shmmap.client import RetentionPolicy as RetentionPolicy
    from shmmap.client import WindowUpdate as WindowUpdate
    from shmmap.client import connect as connect
    from shmmap.formats.cloud import read_cloud as read_cloud
    from shmmap.formats.pcd.writer import write_pcd as write_pcd
    from shmmap.geometry import Area as Area
    from shmmap.geometry import AutowareSquare as AutowareSquare
    from shmmap.geometry import Box as Box
    from shmmap.geometry import Circle as Circle

_PACKAGES: Final = ("errors", "events", "layers", "live")
"""Modules with the other public names."""

# No `__all__`: with it, `help(shmmap)` would print the whole help of every class, seven thousand lines.
_load = lazy_public_names(__name__)


if not TYPE_CHECKING:  # type checkers report names that are not in the list

    def __getattr__(name: str) -> Any:
        if name in _PACKAGES:
            return importlib.import_module(f"shmmap.{name}")
        try:
            return _load(name)
        except AttributeError:
            for package in _PACKAGES:
                try:
                    names = importlib.import_module(f"shmmap.{package}").__all__
                except ShmmapError:  # it was replaced: where the name is cannot be said
                    continue
                if name in names:
                    error = AttributeError(
                        f"module 'shmmap' has no attribute {name!r}: it is shmmap.{package}.{name}"
                    )
                    raise error from None
            raise


def __dir__() -> list[str]:
    errors = [
        name for name, value in globals().items() if isinstance(value, type) and issubclass(value, Exception)
    ]
    return sorted({*public_names(__name__), *errors, *_PACKAGES, "__version__"})
