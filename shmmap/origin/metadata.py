# SPDX-License-Identifier: Apache-2.0
"""Reads a divided map's metadata, ``pointcloud_map_metadata.yaml``, by lines or as YAML, and writes it.

The file is a YAML mapping: ``x_resolution`` and ``y_resolution`` (metres), and for each PCD file its
base name with the lower left corner of its cell::

    x_resolution: 20.0
    y_resolution: 20.0
    A.pcd: [1200, 2500]

Autoware's loader (autoware_map_loader, ``load_pcd_metadata``) takes every other key for a base name
and its value for a vector of int, so a float corner or a scalar value makes it fail.  Here those are
*strict* rules; otherwise float corners are read, unknown keys ignored, and both reported.

A YAML parser takes minutes for a million entries.  So `collect_lines` reads files with one ``name: [x, y]`` a
line, as programs write them.  If any line has another form, the YAML parser reads the whole file.  Every line
that `collect_lines` accepts has the same meaning in YAML.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from shmmap.errors import MapDataError, MapMissing
from shmmap.segment.process_limits import raise_limit_behind

# yaml-cpp reads integers as C++ streams do: a leading 0x is hexadecimal, a leading 0 octal
_INTEGER = re.compile(r"[-+]?(?:0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_INT32 = range(-(2**31), 2**31)
_RESOLUTIONS = (b"x_resolution", b"y_resolution")
_FARTHEST_M = 1e12
_BELOW = f"below {_FARTHEST_M:g} m"
_FLUSH_ENTRIES = 1 << 14
_NAMED_IN_PROBLEMS = 3
_MAX_DIGITS = 64
MAX_NAME_BYTES = 255
"""Longest file name that a file system takes; each row of the table of names is as wide as the longest."""
_SHOWN = 80


def _read_corner(text: str, *, strict: bool) -> float | None:
    """Return one corner coordinate in metres; None if the rules (``strict`` or not) refuse the text."""
    if len(text) > _MAX_DIGITS:
        return None
    if _INTEGER.fullmatch(text):
        digits = text.lstrip("+-")
        base = 16 if digits[:2] in ("0x", "0X") else 8 if digits.startswith("0") else 10
        value = int(digits, base) * (-1 if text.startswith("-") else 1)
        return float(value) if value in _INT32 or (not strict and abs(value) < _FARTHEST_M) else None
    if strict or not _FLOAT.fullmatch(text):
        return None
    number = float(text)
    return number if abs(number) < _FARTHEST_M else None


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
        Oddities that were ignored, one sentence each.
    """

    names: NDArray[np.bytes_]
    corners: NDArray[np.float64]
    x_resolution: float
    y_resolution: float
    problems: tuple[str, ...]


@dataclass(slots=True)
class EntryCollector:
    """Collects the keys and values that either parser reads; methods return False to refuse an entry."""

    strict: bool
    resolutions: dict[bytes, float] = field(default_factory=dict)
    _names: list[bytes] = field(default_factory=list)
    _corners: list[tuple[float, float]] = field(default_factory=list)
    _name_blocks: list[NDArray[np.bytes_]] = field(default_factory=list)
    _corner_blocks: list[NDArray[np.float64]] = field(default_factory=list)
    _oddities: dict[str, list[str]] = field(default_factory=dict)

    def scalar(self, key: bytes, text: str) -> bool:
        """Add ``key: text``: a resolution, or an unknown key."""
        if key not in _RESOLUTIONS:
            if not self.strict:
                self.report("unknown key ignored", key)
            return not self.strict
        value = float(text) if _FLOAT.fullmatch(text) else math.nan
        if not 0 < value < _FARTHEST_M:
            return False
        self.resolutions[key] = value
        return True

    def entry(self, key: bytes, x: str, y: str) -> bool:
        """Add ``key: [x, y]``."""
        if key in _RESOLUTIONS or len(key) > MAX_NAME_BYTES:
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
        """Add many entries with integer corners at once: names (N,), corners (N, 2)."""
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
        """Return the metadata; None if a resolution is missing.  The last of repeated keys counts."""
        if len(self.resolutions) < len(_RESOLUTIONS):
            return None
        self._flush()
        names = np.concatenate(self._name_blocks) if self._name_blocks else np.array([], dtype=np.bytes_)
        corners = np.concatenate(self._corner_blocks) if self._corner_blocks else np.empty((0, 2))
        # unique() finds first occurrences; in the reversed array these are the last ones
        _, last = np.unique(names[::-1], return_index=True)
        if len(last) < len(names):
            kept = np.sort(len(names) - 1 - last)
            for index in np.setdiff1d(np.arange(len(names)), kept).tolist():
                self.report("repeated entry, the last one counts", bytes(names[index]))
            names, corners = names[kept], corners[kept]
        x_key, y_key = _RESOLUTIONS
        problems = tuple(f"{what}: {list_some(keys)}" for what, keys in self._oddities.items())
        return MapMetadata(names, corners, self.resolutions[x_key], self.resolutions[y_key], problems)

    def _flush(self) -> None:
        if self._names:
            self._name_blocks.append(np.array(self._names, dtype=np.bytes_))
            self._corner_blocks.append(np.array(self._corners, dtype=np.float64))
            self._names, self._corners = [], []


def shortened(text: str) -> str:
    """Return a text from a file, cut to a length that suits a message."""
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}... ({len(text):,} characters)"


def list_some(names: list[str]) -> str:
    """List the first few of ``names``, with the total number if there are more."""
    some = ", ".join(names[:_NAMED_IN_PROBLEMS])
    return some if len(names) <= _NAMED_IN_PROBLEMS else f"{some}, ... ({len(names)} in all)"


MAX_METADATA_BYTES: Final = 1 << 30
"""Size limit of a metadata file; a map of ten million cells takes half of it."""
TOO_LARGE: Final = "too_large"

# The C parser where PyYAML was built with it; both report the same events.
_LOADER: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)

# The parser's time grows with the square of the depth; metadata needs two levels.
_MAX_DEPTH = 64
# libyaml 0.2.6 refuses a depth of 1000 itself, possibly before it has reported a first event.
_TOO_DEEP_FOR_LIBYAML = "exceeded maximum nesting depth"

# The parser's time also grows with the square of the number of tag directives; metadata needs none.
_TAG_DIRECTIVE = re.compile(rb"^%TAG", re.MULTILINE)

_BLOCK_BYTES = 1 << 17  # small enough that one odd line sends few other lines to the slower pattern
_PLAIN_NAME = rb"([A-Za-z0-9_.+()/][A-Za-z0-9_.+()/=@-]{0,254})"
_PLAIN_INTEGER = rb"(-?(?:0|[1-9][0-9]{0,8}))"
_PLAIN_LINE = re.compile(  # a line as the divider writes it
    rb"^%b: \[%b, %b\]\n" % (_PLAIN_NAME, _PLAIN_INTEGER, _PLAIN_INTEGER), re.MULTILINE
)
_LINE = re.compile(
    rb"""
    (?: \#[\x20-\x7e\t]*
      | (?: (?P<plain> -?[A-Za-z0-9_./+(][A-Za-z0-9_./+()=@-]* )
          | "(?P<double> [ A-Za-z0-9_./+()=@-]+ )"
          | '(?P<single> [ A-Za-z0-9_./+()=@-]+ )' )
        [ ]* : [ ]+
        (?: \[ [ ]* (?P<x> [-+.0-9a-zA-Z]+ ) [ ]* , [ ]* (?P<y> [-+.0-9a-zA-Z]+ ) [ ]* \]
          | (?P<scalar> [A-Za-z0-9_.+-]+ ) )
        (?: [ ]+ \#[\x20-\x7e\t]* )?
    )?
    [ ]* \r?\n
    """,
    re.VERBOSE,
)


def metadata_bytes(path: str, max_bytes: int = MAX_METADATA_BYTES, *, at: str = "") -> bytes:
    """Return the bytes of the metadata file at ``path``, opened by ``at`` if that is given.

    Raises
    ------
    MapMissing
        The file does not exist, or may not be read.
    LimitReached
        A limit of this process or the machine does not let it open the file.
    MapDataError
        The file is larger than ``max_bytes``; the error's cause is `TOO_LARGE`.
    """
    try:
        with open(at or path, "rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise_limit_behind(error)
        raise MapMissing(f"cannot read the map's metadata {path}: {error.strerror}") from error
    if len(data) > max_bytes:
        raise MapDataError(
            f"more than {max_bytes >> 20} MiB of metadata",
            path=path,
            cause=TOO_LARGE,
            hint="it has a line for each cell: is it the map's metadata?",
        )
    return data


def parse_metadata(data: bytes, *, path: str, strict: bool = False, lines: bool = True) -> MapMetadata:
    """Parse the bytes of a metadata file; ``path`` is for messages.

    ``lines=False`` goes straight to the YAML parser: slower, with the same result.
    """
    entries = EntryCollector(strict)
    if not (lines and collect_lines(data, entries)):
        entries = EntryCollector(strict)
        _EventReader(data, entries, path).read()
    metadata = entries.metadata()
    if metadata is None:
        missing = " and ".join(
            key for key in ("x_resolution", "y_resolution") if key.encode() not in entries.resolutions
        )
        raise MapDataError(f"{missing} missing", path=path, cause="no_resolution")
    return metadata


def collect_lines(data: bytes, entries: EntryCollector) -> bool:
    """Read all lines of ``data`` into ``entries``; return False if a line needs the YAML parser."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    for opening in (b"---\n", b"---\r\n"):
        data = data.removeprefix(opening)
    if not data.endswith(b"\n"):
        data += b"\n"
    start = 0
    while start < len(data):
        stop = data.find(b"\n", min(start + _BLOCK_BYTES, len(data) - 1)) + 1
        block = data[start:stop]
        if not (_collect_plain(block, entries) or _collect_each(block, entries)):
            return False
        start = stop
    return True


def _collect_plain(block: bytes, entries: EntryCollector) -> bool:
    """Read a block if all its lines match `_PLAIN_LINE`, four times as fast; else return False."""
    found = _PLAIN_LINE.findall(block)
    if not found or len(found) != block.count(b"\n"):
        return False
    names, x, y = zip(*found, strict=True)
    return entries.block(np.array(names), np.array((x, y)).astype(np.int64).T.astype(np.float64))


def _collect_each(block: bytes, entries: EntryCollector) -> bool:
    """Read a block line by line, with quotes, comments, floats, spaces and CRLF; False if that fails."""
    position = 0
    while position < len(block):
        line = _LINE.match(block, position)  # no search: on a long line that takes quadratic time
        if line is None:
            return False
        position = line.end()
        name = line["plain"] or line["double"] or line["single"]
        if name is None:
            continue
        if line["scalar"] is not None:
            taken = entries.scalar(name, line["scalar"].decode())
        else:
            taken = entries.entry(name, line["x"].decode(), line["y"].decode())
        if not taken:
            return False
    return True


class _EventReader:
    """Reads YAML of any style from parser events, without recursion however deep the file nests.

    Parameters
    ----------
    data
        Bytes of the file.
    entries
        Receives the entries.
    path
        Path of the file, for messages.
    """

    def __init__(self, data: bytes, entries: EntryCollector, path: str) -> None:
        self._data = data
        self._entries = entries
        self._path = path
        self._depth = 0
        self._key: str | None = None
        """Key of the entry being read; None between entries."""
        self._values: list[str] = []
        self._is_nested = False

    def read(self) -> None:
        """Read the first document, as yaml-cpp's LoadFile does.

        Raises
        ------
        MapDataError
            The file is not YAML, or not a mapping of names to corners.
        """
        if tag := _TAG_DIRECTIVE.search(self._data):
            raise MapDataError(
                "tag directives are not read",
                path=self._path,
                offset=tag.start(),
                cause="bad_yaml",
                hint="metadata needs none: remove the line that begins with %TAG",
            )
        try:
            for event in yaml.parse(self._data, Loader=_LOADER):
                if isinstance(event, yaml.DocumentEndEvent):
                    return
                self._follow(event)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            if mark is None:
                raise MapDataError(f"no YAML: {error.problem}", path=self._path, cause="bad_yaml") from error
            if error.problem == _TOO_DEEP_FOR_LIBYAML:
                raise self._refusal("nested too deeply", mark) from error
            raise self._refusal(f"no YAML: {error.problem}", mark) from error
        except yaml.YAMLError as error:
            raise MapDataError(f"no YAML: {error}", path=self._path, cause="bad_yaml") from error

    def _refusal(self, message: str, mark: Any, cause: str = "bad_yaml") -> MapDataError:
        return MapDataError(
            f"line {mark.line + 1}: {message}",
            path=self._path,
            offset=_line_offset(self._data, mark.line),
            cause=cause,
        )

    def _follow(self, event: yaml.Event) -> None:
        if isinstance(event, yaml.ScalarEvent):
            self._scalar(event)
        elif isinstance(event, yaml.CollectionStartEvent):
            self._begin(event)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._depth -= 1
            if self._depth == 1 and self._key is not None:
                self._take(self._key, None if self._is_nested else self._values, event.start_mark)
        elif isinstance(event, yaml.AliasEvent):
            raise self._refusal("aliases are not read", event.start_mark)

    def _begin(self, event: yaml.CollectionStartEvent) -> None:
        is_mapping = isinstance(event, yaml.MappingStartEvent)
        if self._depth == 0 and not is_mapping:
            raise self._refusal("the file is not a YAML mapping", event.start_mark)
        if self._depth == 1 and self._key is None:
            raise self._refusal("a key must be a name", event.start_mark)
        if self._depth >= _MAX_DEPTH:
            raise self._refusal("nested too deeply", event.start_mark)
        self._is_nested = self._depth > 1 or (self._depth == 1 and is_mapping)
        self._depth += 1

    def _scalar(self, event: yaml.ScalarEvent) -> None:
        if self._depth == 0:
            raise self._refusal("the file is not a YAML mapping", event.start_mark)
        if self._depth > 1:
            self._values.append(event.value)
        elif self._key is None:
            self._key, self._values, self._is_nested = event.value, [], False
        else:
            self._take(self._key, event.value, event.start_mark)

    def _take(self, key: str, value: list[str] | str | None, mark: Any) -> None:
        """Pass the entry that ends at ``mark`` to the collector; ``value`` is None if nested."""
        entries = self._entries
        name, key = key.encode(), shortened(key)
        self._key = None
        if isinstance(value, str):
            if entries.scalar(name, value):
                return
            if key in ("x_resolution", "y_resolution"):
                raise self._refusal(
                    f"{key} must be a positive number of metres, not {shortened(value)!r} ({_BELOW})",
                    mark,
                    "no_resolution",
                )
            raise self._refusal(f"{key} is not an [x, y] corner", mark, "unknown_key")
        if value is None:
            if entries.strict:
                raise self._refusal(f"{key} is not an [x, y] corner", mark, "unknown_key")
            entries.report("unknown key ignored", name)
            return
        if len(value) < 2:
            raise self._refusal(f"{key} needs two values, x and y", mark, "bad_corner")
        if len(value) > 2:
            entries.report("values after x and y ignored", name)
        if not entries.entry(name, value[0], value[1]):
            if len(name) > MAX_NAME_BYTES:
                raise self._refusal(f"{key}: no file has so long a name", mark, "bad_corner")
            kind, limit = ("integers", "of 32 bits") if entries.strict else ("numbers", _BELOW)
            corner = ", ".join(map(shortened, value[:2]))
            raise self._refusal(
                f"{key}: the corner must be two {kind}, not [{corner}] ({limit})", mark, "bad_corner"
            )


def _line_offset(data: bytes, line: int) -> int:
    """Return the byte offset at which the 0-based ``line`` starts."""
    offset = 0
    for _ in range(line):
        offset = data.find(b"\n", offset) + 1
        if not offset:
            return len(data)
    return offset


METADATA_NAME: Final = "pointcloud_map_metadata.yaml"
_PLAIN_KEY: Final = re.compile(r"[A-Za-z0-9_.][A-Za-z0-9_.+-]*")


def metadata_text(size: str, entries: Iterable[tuple[str, tuple[str, str]]], size_y: str = "") -> str:
    """Return the text of a metadata file for cells of ``size`` metres.

    Each entry is (file name, (x, y) of the corner).  Cells that are not square have ``size_y`` along y.
    Numbers are given as text, so that whole numbers stay integers; names are quoted where YAML needs it.
    """
    lines = [f"x_resolution: {size}\n", f"y_resolution: {size_y or size}\n"]
    for name, corner in sorted(entries):
        key = name if _PLAIN_KEY.fullmatch(name) else json.dumps(name, ensure_ascii=False)
        lines.append(f"{key}: [{', '.join(corner)}]\n")
    return "".join(lines)
