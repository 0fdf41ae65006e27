# SPDX-License-Identifier: Apache-2.0
"""Scans over ZeroMQ: the source binds a publisher, and readers subscribe.

A message has a first frame in msgpack, ``{"shmmap_scan": 1, "name", "stamp_s", "pose", "columns"}``,
and one frame of plain bytes for each column.  ``pose`` is null or 16 numbers, the rows of
T_map_sensor; ``columns`` are ``[name, dtype, shape]`` with numpy's dtype strings (``"<f4"``), in the
order of the frames.  ``"no_map": true`` marks a filtered scan without map around it.
``"last": true`` (without columns) marks the end of the stream; it may be repeated until readers unsubscribe.
"""

from __future__ import annotations

import math
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.trajectory import pose_of
from shmmap_clients.streams import Publisher, Subscriber

_VERSION: Final = 1
_QUEUE: Final = 64  # scans queued for a slow reader; further scans are dropped
_LINGER_MS: Final = 10_000


class _Head(msgspec.Struct, omit_defaults=True):
    shmmap_scan: int = 0
    name: str = ""
    stamp_s: float = 0.0
    pose: list[float] | None = None
    columns: list[tuple[str, str, list[int]]] = []
    no_map: bool = False
    last: bool = False


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Head)


def encode_scan(scan: Scan | None) -> list[bytes]:
    """Return the frames of a scan, or of the end of the stream."""
    if scan is None:
        return [_encoder.encode(_Head(_VERSION, last=True))]
    arrays = {name: np.ascontiguousarray(values) for name, values in scan.columns.items()}
    pose = None if scan.T_map_sensor is None else [float(v) for v in scan.T_map_sensor.ravel()]
    columns = [(name, values.dtype.str, list(values.shape)) for name, values in arrays.items()]
    head = _Head(_VERSION, scan.name, scan.stamp_s, pose, columns, scan.no_map)
    return [_encoder.encode(head), *(values.tobytes() for values in arrays.values())]


def decode_scan(frames: list[bytes]) -> Scan | None:
    """Return the scan, None at the end of the stream.

    Raises
    ------
    BadRequest
        The frames are not a scan.
    """
    try:
        head = _decoder.decode(frames[0])
        if head.shmmap_scan != _VERSION:
            raise ValueError(f"version {head.shmmap_scan}, not {_VERSION}")
        if head.last:
            return None
        if len(frames) != len(head.columns) + 1:
            raise ValueError(f"{len(frames) - 1} frames for {len(head.columns)} columns")
        columns: dict[str, NDArray[Any]] = {}
        for (name, dtype, shape), frame in zip(head.columns, frames[1:], strict=True):
            kind = np.dtype(dtype)
            if kind.kind not in "fiu":
                raise ValueError(f"column {name!r} of type {dtype}")
            columns[name] = np.frombuffer(frame, kind).reshape(shape)
        xyz = columns.get("xyz")
        if xyz is None or xyz.ndim != 2 or xyz.shape[1] != 3:
            raise ValueError("no column xyz of shape (N, 3)")
        if any(len(values) != len(xyz) for values in columns.values()):
            raise ValueError("columns of different lengths")
        if not math.isfinite(head.stamp_s):
            raise ValueError("a time that is not finite")
        pose = None if head.pose is None else pose_of(head.pose)
    except (msgspec.DecodeError, BadRequest, ValueError, TypeError, IndexError) as error:
        raise BadRequest(f"a message that is no scan: {error}") from None
    return Scan(head.name, head.stamp_s, columns, pose, head.no_map)


class ScanPublisher(Publisher):
    """Publisher of scans.

    Parameters
    ----------
    endpoint
        Address to bind, such as ``ipc:///tmp/scans`` or ``tcp://127.0.0.1:5600``.

    Raises
    ------
    BadRequest
        The address cannot be bound.
    """

    def __init__(self, endpoint: str) -> None:
        super().__init__(endpoint, queue=_QUEUE, linger_ms=_LINGER_MS)

    def send(self, scan: Scan | None) -> None:
        """Send a scan; None marks the end of the stream."""
        self.publish(encode_scan(scan), last=scan is None)


class ScanSubscriber(Subscriber):
    """Iterator over the scans of a publisher; the end of the stream also ends the subscription.

    Parameters
    ----------
    endpoint
        Address of the publisher.

    Raises
    ------
    BadRequest
        The address is invalid.
    """

    def __init__(self, endpoint: str) -> None:
        super().__init__(endpoint, queue=_QUEUE)

    def __iter__(self) -> ScanSubscriber:
        return self

    def __next__(self) -> Scan:
        scan = None if self.closed else decode_scan(self.receive())
        if scan is None:
            self.close()  # the publisher repeats the end until no subscriber is left
            raise StopIteration
        return scan
