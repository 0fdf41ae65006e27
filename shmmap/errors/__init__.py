# SPDX-License-Identifier: Apache-2.0
"""Every error shmmap raises on purpose, in one tree.

::

    ShmmapError
    ├── ConfigError            a setting is wrong (key, where it came from)       exit 78
    ├── BadRequest             an argument or a message makes no sense            exit 2
    │   └── NoColumn           a layer has no such column; also a `KeyError`
    ├── MapDataError           a file is not what it claims to be                 exit 65
    ├── MapMissing             there is no map there                              exit 66
    ├── CannotWrite            an output cannot be made: disk full, no permission exit 73
    ├── DaemonUnreachable      nobody answers                                     exit 69
    │   ├── NoSocket           nothing listens: the daemon was never started
    │   ├── SocketPermission   the socket is there, but not for this user
    │   ├── StaleSocket        the socket's daemon is gone
    │   ├── ConnectionLost     the daemon was connected, and closed the connection
    │   └── NoAnswer           no reply before the deadline; also a `TimeoutError`
    ├── ProtocolMismatch       client and daemon speak different versions         exit 76
    ├── InstanceBusy           another daemon owns this instance                  exit 75
    ├── NoSession              the daemon does not know this session: say hello   exit 1
    ├── NotPermitted           the daemon refuses this to this user               exit 1
    ├── Busy                   too many requests of this process wait already     exit 75
    ├── SegmentError           a segment cannot be used
    │   ├── StaleHandle        it is gone: ask again                              exit 1
    │   └── SegmentCorrupt     its bytes are wrong (magic, version, checksum)     exit 65
    ├── CellError              one cell could not be had; others are unaffected   exit 1
    │   ├── UnknownCell        the map has no such cell
    │   ├── LoadFailed         its source cannot be read
    │   ├── LoadTimeout        loading took longer than its deadline
    │   ├── OverBudget         it does not fit in memory; `holders` says who uses it
    │   └── NoSpace            the shared-memory file system is full
    ├── PackageMissing         a Python package is not installed                  exit 69
    └── InternalError          a defect in shmmap: please report it               exit 70

``code`` is what travels on the wire, ``exit_code`` what the command line returns, ``hint`` what the
reader can do about it.
"""

from shmmap.errors.packages import needed_packages
from shmmap.errors.tree import (
    BadRequest,
    Busy,
    CannotWrite,
    CellError,
    ConfigError,
    ConnectionLost,
    DaemonUnreachable,
    InstanceBusy,
    InternalError,
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
    OverBudget,
    PackageMissing,
    ProtocolMismatch,
    SegmentCorrupt,
    SegmentError,
    ShmmapError,
    SocketPermission,
    StaleHandle,
    StaleSocket,
    UnknownCell,
    error_from_wire,
)

__all__ = [
    "BadRequest",
    "Busy",
    "CannotWrite",
    "CellError",
    "ConfigError",
    "ConnectionLost",
    "DaemonUnreachable",
    "InstanceBusy",
    "InternalError",
    "LoadFailed",
    "LoadTimeout",
    "MapDataError",
    "MapMissing",
    "NoAnswer",
    "NoColumn",
    "NoSession",
    "NoSocket",
    "NoSpace",
    "NotPermitted",
    "OverBudget",
    "PackageMissing",
    "ProtocolMismatch",
    "SegmentCorrupt",
    "SegmentError",
    "ShmmapError",
    "SocketPermission",
    "StaleHandle",
    "StaleSocket",
    "UnknownCell",
    "error_from_wire",
    "needed_packages",
]
