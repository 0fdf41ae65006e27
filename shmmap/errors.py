# SPDX-License-Identifier: Apache-2.0
"""Every error shmmap raises on purpose, in one tree.

::

    ShmmapError
    ├── ConfigError            a setting is wrong (key, and its origin)           exit 78
    ├── BadRequest             an argument or a message is invalid                exit 2
    │   └── NoColumn           a layer has no such column; also a `KeyError`
    ├── MapDataError           a file is damaged or invalid                       exit 65
    ├── MapMissing             there is no map there                              exit 66
    ├── CannotWrite            an output cannot be made: disk full, no permission exit 73
    ├── DaemonUnreachable      no daemon answers                                  exit 69
    │   ├── NoSocket           nothing listens: the daemon was never started
    │   ├── SocketPermission   the socket is there, but not for this user
    │   ├── StaleSocket        the socket's daemon is gone
    │   ├── ConnectionLost     the daemon was connected, and closed the connection
    │   └── NoAnswer           no reply before the deadline; also a `TimeoutError`
    ├── ProtocolMismatch       client and daemon speak different versions         exit 76
    ├── InstanceBusy           another daemon owns this instance                  exit 75
    ├── CannotStart            what hinders the daemon's start can pass           exit 71
    ├── NoSession              the daemon does not know this session: say hello   exit 1
    ├── NotPermitted           the daemon refuses this to this user               exit 1
    ├── LimitReached           this process may have no more files, threads, memory   exit 71
    ├── Busy                   too many requests of this process wait already     exit 75
    ├── LiveInterrupted        the live worker starts again: ask again            exit 75
    ├── SegmentError           a segment cannot be used
    │   ├── StaleHandle        it is gone: ask again                              exit 1
    │   └── SegmentCorrupt     its bytes are wrong (magic, version, checksum)     exit 65
    ├── CellError              one cell was not loaded; others are unaffected     exit 1
    │   ├── UnknownCell        the map has no such cell
    │   ├── LoadFailed         its source cannot be read
    │   ├── LoadTimeout        loading took longer than its deadline
    │   ├── OverBudget         it does not fit in memory, which `holders` fill
    │   ├── NoSpace            the shared-memory file system is full
    │   └── Offline            its origin cannot be reached at present           exit 75
    ├── PackageMissing         a Python package is not installed                  exit 69
    ├── Replaced               shmmap was upgraded under this process             exit 69
    └── InternalError          a defect in shmmap: please report it               exit 70

``code`` is the error's name in the protocol, ``exit_code`` the command's exit code, ``hint`` the remedy.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Final

if TYPE_CHECKING:
    from shmmap.protocol.rows import Holder

__all__ = [
    "BadRequest",
    "Busy",
    "CannotStart",
    "CannotWrite",
    "CellError",
    "ConfigError",
    "ConnectionLost",
    "DaemonUnreachable",
    "InstanceBusy",
    "InternalError",
    "LimitReached",
    "LiveInterrupted",
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
    "Offline",
    "OverBudget",
    "PackageMissing",
    "ProtocolMismatch",
    "Replaced",
    "SegmentCorrupt",
    "SegmentError",
    "ShmmapError",
    "ShmmapWarning",
    "SocketPermission",
    "StaleHandle",
    "StaleSocket",
    "UnknownCell",
    "error_from_wire",
    "warn_program",
]

_NO_PROGRAM: Final = ("shmmap.", "shmmap_clients.", "asyncio.")
"""How names of modules begin that only stand between a program and a warning."""


class ShmmapError(Exception):
    """Base of every error shmmap raises on purpose.

    Parameters
    ----------
    message, hint
        The problem and its place, in one sentence; and the remedy, if there is one.
    """

    code: ClassVar[str] = "error"
    exit_code: ClassVar[int] = 70
    advice: ClassVar[str] = ""  # the default hint

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint or self.advice

    def __str__(self) -> str:
        return f"{self.message} ({self.hint})" if self.hint else self.message


class ShmmapWarning(UserWarning):
    """A result is incomplete or contradictory; the text contains the details and the reason."""


def warn_program(text: str) -> None:
    """Issue a `ShmmapWarning` at the line of the program that called the library."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith(_NO_PROGRAM):
        level, frame = level + 1, frame.f_back
    warnings.warn(text, ShmmapWarning, stacklevel=level)


class ConfigError(ShmmapError):
    """A setting is wrong; ``key`` is its name and ``origin`` the place where it was set."""

    code = "bad_config"
    exit_code = 78

    def __init__(self, message: str, *, key: str = "", origin: str = "", hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.key = key
        self.origin = origin


class BadRequest(ShmmapError):
    """An argument or a message is invalid; repeating the same request cannot succeed."""

    code = "bad_request"
    exit_code = 2


class NoColumn(BadRequest, KeyError):
    """A cell's layer does not have the named or required column."""

    code = "no_column"


class MapDataError(ShmmapError):
    """The file ``path`` is damaged or invalid at byte ``offset``; None if there is no single place.

    ``cause`` is one of a small set of names, for programs: ``truncated``, ``zero_filled``, ...
    """

    code = "bad_map_data"
    exit_code = 65

    def __init__(
        self,
        message: str,
        *,
        path: str = "",
        offset: int | None = None,
        cause: str = "bad_data",
        hint: str = "",
    ) -> None:
        place = f" (at byte {offset})" if offset is not None else ""
        super().__init__(f"{path}: {message}{place}" if path else message + place, hint=hint)
        self.path = path
        self.offset = offset
        self.cause = cause


class MapMissing(ShmmapError):
    """There is no map at the given place."""

    code = "map_missing"
    exit_code = 66


class CannotWrite(ShmmapError):
    """An output cannot be written: the disk is full or not writable, or another file is in its place."""

    code = "cannot_write"
    exit_code = 73  # EX_CANTCREAT of sysexits.h


class DaemonUnreachable(ShmmapError):
    """No daemon answers at the endpoint; the subclass gives the reason."""

    code = "unreachable"
    exit_code = 69


class NoSocket(DaemonUnreachable):
    """Nothing listens at the endpoint: the daemon was never started, or listens elsewhere."""

    code = "no_socket"


class SocketPermission(DaemonUnreachable):
    """The socket exists, but this user may not connect to it."""

    code = "no_permission"


class StaleSocket(DaemonUnreachable):
    """The socket file is left over from a daemon that is gone."""

    code = "stale_socket"


class ConnectionLost(DaemonUnreachable):
    """The daemon closed the connection: it ended, or is being restarted."""

    code = "connection_lost"


class NoAnswer(DaemonUnreachable, TimeoutError):
    """The daemon did not answer before the deadline: it is stopped, hung or overloaded."""

    code = "no_answer"


class ProtocolMismatch(ShmmapError):
    """Client and daemon speak different protocol versions, or the peer is no shmmap daemon."""

    code = "protocol_mismatch"
    exit_code = 76


class InstanceBusy(ShmmapError):
    """Another daemon already owns this instance."""

    code = "instance_busy"
    exit_code = 75


class CannotStart(ShmmapError):
    """The daemon cannot start now, but perhaps later: a required resource is unavailable."""

    code = "cannot_start"
    exit_code = 71  # EX_OSERR of sysexits.h


class NoSession(ShmmapError):
    """The daemon does not know the connection's session, after a restart: send `Hello` again."""

    code = "no_session"
    exit_code = 1


class NotPermitted(ShmmapError):
    """The daemon refuses this operation to this user."""

    code = "not_permitted"
    exit_code = 1


class LimitReached(ShmmapError):
    """A limit of this process on files, threads or memory is reached; the message names the limit."""

    code = "limit_reached"
    exit_code = 71  # EX_OSERR of sysexits.h


class Busy(ShmmapError):
    """Too many requests wait for their answers, or a live map waits for room: the message says for which."""

    code = "busy"
    exit_code = 75


class LiveInterrupted(ShmmapError):
    """The process that keeps live maps ended before it answered: repeat the request, it counts once."""

    code = "live_interrupted"
    exit_code = 75


class SegmentError(ShmmapError):
    """A shared-memory segment cannot be used."""

    code = "segment_error"
    exit_code = 65


class StaleHandle(SegmentError):
    """The segment that a handle names is gone (evicted, or replaced by a newer version): ask again."""

    code = "stale_handle"
    exit_code = 1


class SegmentCorrupt(SegmentError):
    """A segment's bytes contradict its layout: wrong magic, version, size or checksum."""

    code = "segment_corrupt"


class CellError(ShmmapError):
    """One cell, ``cell_id``, ``layer``, could not be loaded; other cells and requests are unaffected.

    ``holders``, for `OverBudget`, are the users of the memory; ``str`` of each is a readable line.  ``box``
    is the cell's ``min_x, min_y, max_x, max_y`` in metres, map frame; None if that is not known.
    """

    code = "cell_error"
    exit_code = 1

    def __init__(
        self,
        message: str,
        *,
        cell_id: str = "",
        layer: str = "",
        holders: Sequence[Holder] = (),
        box: tuple[float, float, float, float] | None = None,
        hint: str = "",
    ) -> None:
        super().__init__(message, hint=hint)
        self.cell_id = cell_id
        self.layer = layer
        self.holders = tuple(holders)
        self.box = box


class UnknownCell(CellError):
    """The map has no cell of that id."""

    code = "unknown_cell"


class LoadFailed(CellError):
    """The cell's source cannot be read; it is retried when the file changes or after a back-off."""

    code = "load_failed"


class LoadTimeout(CellError):
    """Loading the cell took longer than the daemon's deadline for one load."""

    code = "load_timeout"


class OverBudget(CellError):
    """The cell does not fit in the budget or the session's quota; `holders` fill the memory."""

    code = "over_budget"


class NoSpace(CellError):
    """The shared-memory file system is full."""

    code = "no_space"


class Offline(CellError):
    """The cell's origin cannot be reached at present; the daemon retries by itself."""

    code = "offline"
    exit_code = 75
    advice = "ask again later: each request tries again"


class PackageMissing(ShmmapError, ImportError):
    """A required Python package is not installed; a client-only installation lacks many packages."""

    code = "package_missing"
    exit_code = 69


class Replaced(ShmmapError):
    """shmmap was upgraded or removed while this process runs: what was not loaded before cannot be loaded."""

    code = "replaced"
    exit_code = 69  # EX_UNAVAILABLE of sysexits.h


class InternalError(ShmmapError):
    """A defect in shmmap itself."""

    code = "internal"


def error_from_wire(code: str, message: str, hint: str = "") -> ShmmapError:
    """Return the error that a daemon's reply describes; an unknown code becomes `ShmmapError`."""
    kinds: list[type[ShmmapError]] = [ShmmapError]
    for kind in kinds:
        kinds += kind.__subclasses__()
    return next((kind for kind in kinds if kind.code == code), ShmmapError)(message, hint=hint)
