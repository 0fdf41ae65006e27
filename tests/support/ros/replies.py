# SPDX-License-Identifier: Apache-2.0
"""A reply of the map services as plain values: from each kind of peer, and from the map's files."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from tests.support.divided_map import DividedMap

_TYPES = {"u1": (2, 1, "B"), "u2": (4, 2, "H"), "f4": (7, 4, "f"), "f8": (8, 8, "d")}
"""By numpy's names: the number that `sensor_msgs/PointField` has for it, bytes, letter of `struct`."""


class CellReply(NamedTuple):
    """A cell; its shape is height, width, bigendian, point step, row step, dense."""

    id: str
    box: tuple[float, ...]
    header: tuple[int, int, str]
    shape: tuple[int, ...]
    fields: tuple[tuple[str, int, int, int], ...]
    data: bytes


class Reply(NamedTuple):
    """A reply; ``removed`` is empty for services that have none."""

    header: tuple[int, int, str]
    cells: list[CellReply]
    removed: list[str]

    @property
    def ids(self) -> list[str]:
        """Of the cells, with their versions."""
        return [cell.id for cell in self.cells]

    @property
    def plain(self) -> Reply:
        """The same with the paths of the cells alone; each id has to have a version."""
        return self._replace(cells=[cell._replace(id=path_of(cell.id)) for cell in self.cells])


def path_of(name: str) -> str:
    """The path in a cell's id; behind it are ``@`` and 16 hexadecimal digits."""
    path, at, version = name[:-17], name[-17], name[-16:]
    assert at == "@", name
    assert set(version) <= set("0123456789abcdef"), name
    return path


def from_message(message: Any) -> Reply:
    """What a peer of the package `cyclonedds`, or of rclpy, got."""
    cells = []
    for cell in message.new_pointcloud_with_ids:
        cloud, box = cell.pointcloud, cell.metadata
        cells.append(
            CellReply(
                cell.cell_id,
                (box.min_x, box.min_y, box.max_x, box.max_y),
                _header(cloud.header),
                (
                    cloud.height,
                    cloud.width,
                    int(cloud.is_bigendian),
                    cloud.point_step,
                    cloud.row_step,
                    int(cloud.is_dense),
                ),
                tuple((one.name, one.offset, one.datatype, one.count) for one in cloud.fields),
                bytes(cloud.data),
            )
        )
    return Reply(_header(message.header), cells, list(getattr(message, "ids_to_remove", [])))


def _header(header: Any) -> tuple[int, int, str]:
    return header.stamp.sec, header.stamp.nanosec, header.frame_id


def from_lines(text: str) -> Reply:
    """What the peers in C and C++ print."""
    lines = text.split("\n")
    assert lines[-2:] == ["end", ""], text[-200:]
    header: tuple[int, int, str] | None = None
    cells: list[CellReply] = []
    removed: list[str] = []
    for line in lines[:-2]:
        what, _, rest = line.partition(" ")
        words = rest.split(" ")
        if what == "header":
            header = int(words[0]), int(words[1]), words[2]
        elif what == "cell":
            box = tuple(float.fromhex(word) for word in words[:4])
            cells.append(CellReply(" ".join(words[4:]), box, (0, 0, ""), (), (), b""))
        elif what == "cloud":
            cells[-1] = cells[-1]._replace(header=(int(words[0]), int(words[1]), words[2]))
        elif what == "shape":
            cells[-1] = cells[-1]._replace(shape=tuple(map(int, words)))
        elif what == "field":
            offset, datatype, count, name = words
            one = (name, int(offset), int(datatype), int(count))
            cells[-1] = cells[-1]._replace(fields=(*cells[-1].fields, one))
        elif what == "data":
            cells[-1] = cells[-1]._replace(data=bytes.fromhex(rest))
        else:
            assert what == "remove", line
            removed.append(rest)
    assert header is not None
    return Reply(header, cells, removed)


def expected(town: DividedMap, names: Iterable[str], removed: Iterable[str] = ()) -> Reply:
    """What the files say, written field by field and point by point."""
    cells = []
    for name in names:
        columns = town.points(name)
        fields, offset, form = [], 0, "<"
        for column, values in columns.items():
            code, size, letter = _TYPES[values.dtype.str[1:]]
            fields.append((column, offset, code, 1))
            offset += size
            form += letter
        rows = [
            struct.pack(form, *row) for row in zip(*(one.tolist() for one in columns.values()), strict=True)
        ]
        cells.append(
            CellReply(
                town.id(name),
                tuple(np.array(town.box(name), np.float32).tolist()),
                (0, 0, ""),
                (1, len(rows), 0, offset, offset * len(rows), 1),
                tuple(fields),
                b"".join(rows),
            )
        )
    return Reply((0, 0, "map"), cells, list(removed))
