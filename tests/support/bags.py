# SPDX-License-Identifier: Apache-2.0
"""Bags written by the package rosbags: clouds of several layouts, poses, transforms, velocities."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from shmmap_clients.scans.trajectory import quaternion_of

STORE: Final = get_typestore(Stores.ROS2_JAZZY)
SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
LAYOUTS: Final[dict[str, Any]] = {
    "float32": [("x", "<f4"), ("y", "<f4"), ("z", "<f4")],
    "padded": {
        "names": ["x", "y", "z", "intensity", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2"],
        "offsets": [0, 4, 8, 16, 20],
        "itemsize": 32,
    },
    "doubles": [("x", "<f8"), ("y", "<f8"), ("z", "<f8")],
    "big-endian": [("intensity", "u1"), ("x", ">f4"), ("y", ">f4"), ("z", ">f4"), ("ring", ">u2")],
}
_NUMBERS: Final = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

Entry = tuple[str, int, Any]
"""Topic, time of the recording in nanoseconds, message."""


def made(name: str, *fields: Any) -> Any:
    """Make a message of the type whose name ends so."""
    found = [known for known in STORE.types if known.rsplit("/", 1)[-1] == name]
    return STORE.types[found[0]](*fields)


def header(stamp_ns: int, frame: str) -> Any:
    return made("Header", made("Time", stamp_ns // 10**9, stamp_ns % 10**9), frame)


def cloud(
    xyz: NDArray[Any],
    stamp_ns: int = 0,
    frame: str = "base_link",
    layout: DTypeLike = LAYOUTS["float32"],
    *,
    rows: int = 1,
    row_padding: int = 0,
    **columns: NDArray[Any],
) -> Any:
    """Make a PointCloud2; organised with several rows, each followed by padding."""
    kind = np.dtype(layout)
    points = np.zeros(len(xyz), kind)
    for number, axis in enumerate("xyz"):
        points[axis] = xyz[:, number]
    for name, values in columns.items():
        points[name] = values
    fields = []
    for name, (field, offset) in ((name, kind.fields[name][:2]) for name in kind.names or () if kind.fields):
        count = int(np.prod(field.shape))
        fields.append(made("PointField", name, offset, _NUMBERS[field.base.str[1:]], count))
    width = len(xyz) // rows
    lines = points.view(np.uint8).reshape(rows, -1)
    data = np.hstack([lines, np.full((rows, row_padding), 0xAB, np.uint8)]).ravel()
    orders = {kind.fields[name][0].base.byteorder for name in kind.names or () if kind.fields}
    step = kind.itemsize
    return made(
        "PointCloud2",
        *(
            header(stamp_ns, frame),
            rows,
            width,
            fields,
            ">" in orders,
            step,
            step * width + row_padding,
            data,
        ),
        True,
    )


def _vector(kind: str, values: Iterable[float]) -> Any:
    return made(kind, *map(float, values))


def _pose(T: NDArray[Any]) -> Any:
    """Make a pose of a matrix, or of the seven numbers of a TUM file."""
    numbers = T if T.ndim == 1 else [*T[:3, 3], *quaternion_of(T[:3, :3])]
    return made("Pose", _vector("Point", numbers[:3]), _vector("Quaternion", numbers[3:]))


def odometry(T: NDArray[Any], stamp_ns: int, frame: str = "map", child: str = "base_link") -> Any:
    zeros = np.zeros(36)
    return made(
        "Odometry",
        *(header(stamp_ns, frame), child, made("PoseWithCovariance", _pose(T), zeros)),
        made("TwistWithCovariance", _twist(np.zeros(6)), zeros),
    )


def pose_stamped(T: NDArray[Any], stamp_ns: int, frame: str = "map") -> Any:
    return made("PoseStamped", header(stamp_ns, frame), _pose(T))


def pose_with_covariance(T: NDArray[Any], stamp_ns: int, frame: str = "map") -> Any:
    covered = made("PoseWithCovariance", _pose(T), np.zeros(36))
    return made("PoseWithCovarianceStamped", header(stamp_ns, frame), covered)


def _twist(values: NDArray[Any]) -> Any:
    return made("Twist", _vector("Vector3", values[:3]), _vector("Vector3", values[3:]))


def twist_stamped(values: NDArray[Any], stamp_ns: int, frame: str = "base_link") -> Any:
    return made("TwistStamped", header(stamp_ns, frame), _twist(values))


def twist_with_covariance(values: NDArray[Any], stamp_ns: int, frame: str = "base_link") -> Any:
    covered = made("TwistWithCovariance", _twist(values), np.zeros(36))
    return made("TwistWithCovarianceStamped", header(stamp_ns, frame), covered)


def transforms(*edges: tuple[str, str, NDArray[Any]], stamp_ns: int = 0) -> Any:
    """Make a TFMessage of parents, children, and T_parent_child."""
    made_edges = []
    for parent, child, T in edges:
        q = _vector("Quaternion", quaternion_of(T[:3, :3]))
        made_edges.append(
            made(
                "TransformStamped",
                *(header(stamp_ns, parent), child, made("Transform", _vector("Vector3", T[:3, 3]), q)),
            )
        )
    return made("TFMessage", made_edges)


def write_bag(
    path: Path,
    entries: Sequence[Entry],
    plugin: StoragePlugin = SQLITE,
    compressed: CompressionMode = CompressionMode.NONE,
    *,
    serialized: str = "cdr",
) -> Path:
    """Write a bag of these messages, and return its path."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(compressed, CompressionFormat.ZSTD)
    with writer:
        topics: dict[tuple[str, str], Any] = {}
        for topic, time_ns, message in entries:
            kind = message.__msgtype__
            if (topic, kind) not in topics:
                topics[topic, kind] = writer.add_connection(
                    topic, kind, typestore=STORE, serialization_format=serialized
                )
            writer.write(topics[topic, kind], time_ns, STORE.serialize_cdr(message, kind))
    return path


def storage_file(path: Path) -> Path:
    """Return the only file of a bag with messages."""
    (found,) = [one for one in path.iterdir() if one.name != "metadata.yaml"]
    return found
