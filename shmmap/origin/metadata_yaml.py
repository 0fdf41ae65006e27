# SPDX-License-Identifier: Apache-2.0
"""Reads a divided map's metadata file (``pointcloud_map_metadata.yaml``): by lines, or by a YAML parser.

A YAML parser takes minutes for a million entries.  So `collect_lines` takes files as writers really write
them, one ``name: [x, y]`` a line.  A line that it does not understand declines the whole file, and the
parser reads it: what the lines accept means the same to the parser, so nothing is guessed.
"""

from __future__ import annotations

import re
from typing import Any, Final

import numpy as np
import yaml

from shmmap.errors import MapDataError, MapMissing
from shmmap.origin.metadata_entries import MOST_NAME_BYTES, EntryCollector, MapMetadata, shortened

__all__ = ["MOST_METADATA_BYTES", "TOO_LARGE", "collect_lines", "metadata_bytes", "parse_metadata"]

MOST_METADATA_BYTES: Final = 1 << 30
"""A map of ten million cells has half of that."""
TOO_LARGE: Final = "too_large"

# The C parser where PyYAML was built with it; both report the same events.
_LOADER: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)

# The parser's time grows with the square of the depth; metadata needs two levels.
_MAX_DEPTH = 64
# ... libyaml 0.2.6 refuses a depth of 1000, and may do so before it has reported a first event.
_TOO_DEEP_FOR_LIBYAML = "exceeded maximum nesting depth"

# It grows with the square of the number of tag directives, too; metadata needs none.
_TAG_DIRECTIVE = re.compile(rb"^%TAG", re.MULTILINE)

_BLOCK_BYTES = 1 << 17  # so that one odd line sends few others to the slower pattern
_PLAIN_NAME = rb"([A-Za-z0-9_.+()/][A-Za-z0-9_.+()/=@-]{0,254})"
_PLAIN_INTEGER = rb"(-?(?:0|[1-9][0-9]{0,8}))"
_PLAIN_LINE = re.compile(  # as the divider writes it
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


def metadata_bytes(path: str, most_bytes: int = MOST_METADATA_BYTES, *, at: str = "") -> bytes:
    """Return what is in the metadata file at ``path``; ``at`` is where to find it, if not there.

    Raises
    ------
    MapMissing
        There is no such file, or it may not be read.
    MapDataError
        It has more bytes; the error's cause is `TOO_LARGE`.
    """
    try:
        with open(at or path, "rb") as file:
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise MapMissing(f"cannot read the map's metadata {path}: {error.strerror}") from error
    if len(data) > most_bytes:
        raise MapDataError(
            f"more than {most_bytes >> 20} MiB of metadata", path=path, cause=TOO_LARGE,
            hint="it has a line for each cell: is it the map's metadata?",
        )  # fmt: skip
    return data


def parse_metadata(data: bytes, *, path: str, strict: bool = False, lines: bool = True) -> MapMetadata:
    """Parse the bytes of a metadata file; ``path`` is for messages.

    ``lines=False`` goes straight to the YAML parser: slower, with the same result.
    """
    entries = EntryCollector(strict)
    if not (lines and collect_lines(data, entries)):
        entries = EntryCollector(strict)
        _collect_events(data, entries, path)
    metadata = entries.metadata()
    if metadata is None:
        missing = " and ".join(
            key for key in ("x_resolution", "y_resolution") if key.encode() not in entries.resolutions
        )
        raise MapDataError(f"{missing} missing", path=path, cause="no_resolution")
    return metadata


def collect_lines(data: bytes, entries: EntryCollector) -> bool:
    """Read the whole of ``data`` into ``entries``; False if some line needs the real parser."""
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
    """Take a block all of whose lines are `_PLAIN_LINE`, in a quarter of the time."""
    found = _PLAIN_LINE.findall(block)
    if not found or len(found) != block.count(b"\n"):
        return False
    names, x, y = zip(*found, strict=True)
    return entries.block(np.array(names), np.array((x, y)).astype(np.int64).T.astype(np.float64))


def _collect_each(block: bytes, entries: EntryCollector) -> bool:
    """Take a block line by line: quotes, comments, floats, spaces, CRLF."""
    position = 0
    while position < len(block):
        line = _LINE.match(block, position)  # here or nowhere: to search a long line takes time by its square
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


def _collect_events(data: bytes, entries: EntryCollector, path: str) -> None:
    """Read YAML of any style, from parser events: nothing recurses, however deep the file nests."""
    depth = 0
    key: str | None = None
    value: list[str] | str = []
    nested = False

    def refuse(message: str, mark: Any, cause: str) -> MapDataError:
        return MapDataError(
            f"line {mark.line + 1}: {message}", path=path, offset=_line_offset(data, mark.line), cause=cause
        )

    if tag := _TAG_DIRECTIVE.search(data):
        raise MapDataError(
            "tag directives are not read", path=path, offset=tag.start(), cause="bad_yaml",
            hint="metadata needs none: remove the line that begins with %TAG",
        )  # fmt: skip
    try:
        for event in yaml.parse(data, Loader=_LOADER):
            if isinstance(event, yaml.AliasEvent):
                raise refuse("aliases are not read", event.start_mark, "bad_yaml")
            if isinstance(event, yaml.DocumentEndEvent):
                return  # like yaml-cpp's LoadFile: the first document only
            if isinstance(event, yaml.CollectionStartEvent):
                is_mapping = isinstance(event, yaml.MappingStartEvent)
                if (depth == 0) != is_mapping and depth == 0:
                    raise refuse("the file is not a YAML mapping", event.start_mark, "bad_yaml")
                if depth == 1 and key is None:
                    raise refuse("a key must be a name", event.start_mark, "bad_yaml")
                if depth >= _MAX_DEPTH:
                    raise refuse("nested too deeply", event.start_mark, "bad_yaml")
                nested = depth > 1 or (depth == 1 and is_mapping)
                depth += 1
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            elif isinstance(event, yaml.ScalarEvent):
                if depth == 0:
                    raise refuse("the file is not a YAML mapping", event.start_mark, "bad_yaml")
                if depth == 1 and key is None:
                    key, value, nested = event.value, [], False
                    continue
                if depth == 1:
                    value = event.value
                elif isinstance(value, list):
                    value.append(event.value)
            if depth == 1 and key is not None:
                _take(entries, key, None if nested else value, refuse, event.start_mark)
                key = None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        if mark is None:
            raise MapDataError(f"no YAML: {error.problem}", path=path, cause="bad_yaml") from error
        if error.problem == _TOO_DEEP_FOR_LIBYAML:
            raise refuse("nested too deeply", mark, "bad_yaml") from error
        raise refuse(f"no YAML: {error.problem}", mark, "bad_yaml") from error
    except yaml.YAMLError as error:
        raise MapDataError(f"no YAML: {error}", path=path, cause="bad_yaml") from error


def _take(entries: EntryCollector, key: str, value: list[str] | str | None, refuse: Any, mark: Any) -> None:
    name, key = key.encode(), shortened(key)
    if isinstance(value, str):
        if entries.scalar(name, value):
            return
        if key in ("x_resolution", "y_resolution"):
            raise refuse(
                f"{key} must be a positive number of metres, not {shortened(value)!r}", mark, "no_resolution"
            )
        raise refuse(f"{key} is not an [x, y] corner", mark, "unknown_key")
    if value is None:
        if entries.strict:
            raise refuse(f"{key} is not an [x, y] corner", mark, "unknown_key")
        entries.report("unknown key ignored", name)
        return
    if len(value) < 2:
        raise refuse(f"{key} needs two values, x and y", mark, "bad_corner")
    if len(value) > 2:
        entries.report("values after x and y ignored", name)
    if not entries.entry(name, value[0], value[1]):
        if len(name) > MOST_NAME_BYTES:
            raise refuse(f"{key}: no file has so long a name", mark, "bad_corner")
        kind = "integers" if entries.strict else "numbers"
        raise refuse(
            f"{key}: the corner must be two {kind}, not [{', '.join(map(shortened, value[:2]))}]",
            mark,
            "bad_corner",
        )


def _line_offset(data: bytes, line: int) -> int:
    """Byte offset at which the 0-based ``line`` starts."""
    offset = 0
    for _ in range(line):
        offset = data.find(b"\n", offset) + 1
        if not offset:
            return len(data)
    return offset
