# SPDX-License-Identifier: Apache-2.0
"""What a divided map's metadata says, and the rules for one key and its value.

The file is a YAML mapping: ``x_resolution`` and ``y_resolution`` (metres), and for each PCD file its
base name with the lower left corner of its cell::

    x_resolution: 20.0
    y_resolution: 20.0
    A.pcd: [1200, 2500]

Autoware's loader (autoware_map_loader, ``load_pcd_metadata``) takes every other key for a base name
and its value for a vector of int, so a float corner or a scalar key ends it.  Here those are
*strict* rules; otherwise float corners are read, unknown keys ignored, and both reported.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

__all__ = ["MOST_NAME_BYTES", "EntryCollector", "MapMetadata", "shortened"]

# yaml-cpp reads integers as C++ streams do: a leading 0x is hexadecimal, a leading 0 octal
_INTEGER = re.compile(r"[-+]?(?:0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_INT32 = range(-(2**31), 2**31)
_RESOLUTIONS = (b"x_resolution", b"y_resolution")
_FLUSH_ENTRIES = 1 << 14
_NAMED_IN_PROBLEMS = 3
_MOST_DIGITS = 64
MOST_NAME_BYTES = 255
"""What a file system takes; the table of names has room for the longest in each row."""
_SHOWN = 80


def _read_corner(text: str, *, strict: bool) -> float | None:
    """Value of one corner coordinate in metres, or None if these rules do not take it."""
    if len(text) > _MOST_DIGITS:
        return None
    if _INTEGER.fullmatch(text):
        digits = text.lstrip("+-")
        base = 16 if digits[:2] in ("0x", "0X") else 8 if digits.startswith("0") else 10
        value = int(digits, base) * (-1 if text.startswith("-") else 1)
        return float(value) if not strict or value in _INT32 else None
    if strict or not _FLOAT.fullmatch(text):
        return None
    number = float(text)
    return number if math.isfinite(number) else None


@dataclass(frozen=True, slots=True)
class MapMetadata:
    """Contents of one metadata file.

    Attributes
    ----------
    names
        (N,) bytes, base names of PCD files in the file's order, unique.
    corners
        (N, 2) float64, lower left corner of each cell, metres, map frame.
    x_resolution, y_resolution
        Size of every cell, metres, positive.
    problems
        Oddities that were read over, one sentence each.
    """

    names: NDArray[np.bytes_]
    corners: NDArray[np.float64]
    x_resolution: float
    y_resolution: float
    problems: tuple[str, ...]


@dataclass(slots=True)
class EntryCollector:
    """Gathers keys and values from whichever parser reads the file; methods return False to refuse."""

    strict: bool
    resolutions: dict[bytes, float] = field(default_factory=dict)
    _names: list[bytes] = field(default_factory=list)
    _corners: list[tuple[float, float]] = field(default_factory=list)
    _name_blocks: list[NDArray[np.bytes_]] = field(default_factory=list)
    _corner_blocks: list[NDArray[np.float64]] = field(default_factory=list)
    _oddities: dict[str, list[str]] = field(default_factory=dict)

    def scalar(self, key: bytes, text: str) -> bool:
        """Take ``key: text``: a resolution, or an unknown key."""
        if key not in _RESOLUTIONS:
            if not self.strict:
                self.report("unknown key ignored", key)
            return not self.strict
        value = float(text) if _FLOAT.fullmatch(text) else math.nan
        if not (math.isfinite(value) and value > 0):
            return False
        self.resolutions[key] = value
        return True

    def entry(self, key: bytes, x: str, y: str) -> bool:
        """Take ``key: [x, y]``."""
        if key in _RESOLUTIONS or len(key) > MOST_NAME_BYTES:
            return False
        corner_x, corner_y = _read_corner(x, strict=self.strict), _read_corner(y, strict=self.strict)
        if corner_x is None or corner_y is None:
            return False
        if not (_INTEGER.fullmatch(x) and _INTEGER.fullmatch(y)):
            self.report("corner is not an integer: Autoware's loader refuses it", key)
        self._names.append(key)
        self._corners.append((corner_x, corner_y))
        if len(self._names) >= _FLUSH_ENTRIES:
            self._flush()
        return True

    def block(self, names: NDArray[np.bytes_], corners: NDArray[np.float64]) -> bool:
        """Take many entries with integer corners at once: names (N,), corners (N, 2)."""
        if any(bool((names == key).any()) for key in _RESOLUTIONS):
            return False
        self._flush()
        self._name_blocks.append(names)
        self._corner_blocks.append(corners)
        return True

    def report(self, what: str, key: bytes) -> None:
        """Note an oddity of the entry ``key``."""
        self._oddities.setdefault(what, []).append(shortened(key.decode("utf-8", "replace")))

    def metadata(self) -> MapMetadata | None:
        """Everything taken, or None while a resolution is missing.  A repeated key: the last one counts."""
        if len(self.resolutions) < len(_RESOLUTIONS):
            return None
        self._flush()
        names = np.concatenate(self._name_blocks) if self._name_blocks else np.array([], dtype=np.bytes_)
        corners = np.concatenate(self._corner_blocks) if self._corner_blocks else np.empty((0, 2))
        # unique() finds first occurrences; reversed, they are the last
        _, last = np.unique(names[::-1], return_index=True)
        if len(last) < len(names):
            kept = np.sort(len(names) - 1 - last)
            for index in np.setdiff1d(np.arange(len(names)), kept).tolist():
                self.report("repeated entry, the last one counts", bytes(names[index]))
            names, corners = names[kept], corners[kept]
        x_key, y_key = _RESOLUTIONS
        return MapMetadata(
            names, corners, self.resolutions[x_key], self.resolutions[y_key], tuple(self._problems())
        )

    def _problems(self) -> list[str]:
        return [f"{what}: {list_some(keys)}" for what, keys in self._oddities.items()]

    def _flush(self) -> None:
        if self._names:
            self._name_blocks.append(np.array(self._names, dtype=np.bytes_))
            self._corner_blocks.append(np.array(self._corners, dtype=np.float64))
            self._names, self._corners = [], []


def shortened(text: str) -> str:
    """Return a text from a file as far as a message needs it."""
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}... ({len(text):,} characters)"


def list_some(names: list[str]) -> str:
    """The first few of ``names``, and how many there are when that is not all."""
    some = ", ".join(names[:_NAMED_IN_PROBLEMS])
    return some if len(names) <= _NAMED_IN_PROBLEMS else f"{some}, ... ({len(names)} in all)"
