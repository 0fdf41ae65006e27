# SPDX-License-Identifier: Apache-2.0
"""The text of a map's ``pointcloud_map_metadata.yaml``, as Autoware's loader reads it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from typing import Final

__all__ = ["METADATA_NAME", "metadata_text"]

METADATA_NAME: Final = "pointcloud_map_metadata.yaml"
_PLAIN_KEY: Final = re.compile(r"[A-Za-z0-9_.][A-Za-z0-9_.+-]*")


def metadata_text(size: str, entries: Iterable[tuple[str, tuple[str, str]]], size_y: str = "") -> str:
    """Return the file for cells of ``size`` metres, entries being (file name, (x, y) of the corner).

    Cells that are not square have ``size_y`` along y.

    Numbers come as text, so that whole ones stay integers; names are quoted where YAML needs it.
    """
    lines = [f"x_resolution: {size}\n", f"y_resolution: {size_y or size}\n"]
    for name, corner in sorted(entries):
        key = name if _PLAIN_KEY.fullmatch(name) else json.dumps(name, ensure_ascii=False)
        lines.append(f"{key}: [{', '.join(corner)}]\n")
    return "".join(lines)
