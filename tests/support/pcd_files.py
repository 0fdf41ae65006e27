# SPDX-License-Identifier: Apache-2.0
"""A small PCD writer and reader for tests, independent of shmmap's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_KIND = {"f": "F", "i": "I", "u": "U"}


def write_pcd(path: Path, columns: dict[str, NDArray[Any]]) -> None:
    """Write one-dimensional columns, in order, as a binary PCD; in place, without a temporary file."""
    names = list(columns)
    rows = len(columns[names[0]])
    record = np.zeros(rows, dtype=[(name, columns[name].dtype) for name in names])
    for name in names:
        record[name] = columns[name]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(columns[n].dtype.itemsize) for n in names),
        "TYPE " + " ".join(_KIND[columns[n].dtype.kind] for n in names),
        "COUNT " + " ".join("1" for _ in names),
        f"WIDTH {rows}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {rows}",
        "DATA binary",
    ]
    path.write_bytes("\n".join(lines).encode() + b"\n" + record.tobytes())


def read_pcd(path: Path) -> dict[str, NDArray[Any]]:
    """Read a binary PCD without padding; a field of k > 1 values becomes (N, k)."""
    data = path.read_bytes()
    end = data.index(b"\n", data.index(b"DATA ")) + 1
    keys = {}
    for line in data[:end].decode("ascii", "replace").splitlines():
        if line and not line.startswith("#"):
            key, *values = line.split()
            keys[key.upper()] = values
    assert keys["DATA"] == ["binary"]
    kinds = {"F": "f", "I": "i", "U": "u"}
    described = zip(keys["FIELDS"], keys["TYPE"], keys["SIZE"], keys["COUNT"], strict=True)
    dtype = np.dtype(
        [
            (n, f"<{kinds[t]}{s}", (int(k),)) if k != "1" else (n, f"<{kinds[t]}{s}")
            for n, t, s, k in described
        ]
    )
    record = np.frombuffer(data, dtype, int(keys["POINTS"][0]), end)
    return {name: np.ascontiguousarray(record[name]) for name in keys["FIELDS"]}


def write_ascii(path: Path, points: int) -> Path:
    """Write a file that needs more memory than it is long: "1 2 3" is 6 bytes, three floats are 12."""
    head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {points}\nHEIGHT 1\n"
    path.write_text(f"{head}POINTS {points}\nDATA ascii\n" + "1 2 3\n" * points)
    return path
