# SPDX-License-Identifier: Apache-2.0
"""The documents and the code say the same: every message's elements in order, every table of bytes."""

from __future__ import annotations

import re
from importlib.resources import files
from typing import Any, get_args

import msgspec
import pytest

from shmmap import errors
from shmmap.protocol import events, live
from shmmap.protocol import messages as m
from shmmap.segment import header, layout
from shmmap.statistics import layout as statistics_layout

PROTOCOL = files("shmmap.protocol").joinpath("PROTOCOL.md").read_text(encoding="utf-8")
REQUESTS = PROTOCOL[: PROTOCOL.index("\n## Replies\n")]
EVENTS = PROTOCOL[PROTOCOL.index("\n## Events\n") :]
LAYOUT = files("shmmap.segment").joinpath("LAYOUT.md").read_text(encoding="utf-8")
STATISTICS = files("shmmap.statistics").joinpath("STATISTICS.md").read_text(encoding="utf-8")

SIZES = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "i64": 8, "f64": 8}


def names_in(text: str) -> list[str]:
    """First words of what commas outside brackets separate: ``a int, b [x, y]? = nil`` has a and b."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[{") - (letter in "]}")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.split()[0] for part in parts if part.split()]


def field_names(kind: Any) -> list[str]:
    return [name for name in kind.__struct_fields__ if name != "request"]


def tag_of(kind: Any) -> str:
    tag = kind.__struct_config__.tag
    assert isinstance(tag, str)
    return tag


def defaults_of(kind: type[msgspec.Struct]) -> dict[str, bool]:
    return {field.name: not field.required for field in msgspec.structs.fields(kind)}


@pytest.mark.parametrize("kind", get_args(m.Request), ids=lambda kind: kind.__name__)
def test_requests(kind: Any) -> None:
    (row,) = re.findall(rf"^\| `{tag_of(kind)}` \|(.*)\|.*\|$", REQUESTS, re.MULTILINE)
    elements = re.findall(r"`([^`]*)`", row)
    assert [name for element in elements for name in names_in(element)] == field_names(kind)
    optional = defaults_of(kind)
    for element in elements:
        assert ("=" in element) == optional[names_in(element)[0]], element


@pytest.mark.parametrize("kind", get_args(m.Reply), ids=lambda kind: kind.__name__)
def test_replies(kind: Any) -> None:
    start = PROTOCOL.index(f"\n`{tag_of(kind)}`:")
    paragraph = PROTOCOL[start + len(tag_of(kind)) + 4 : PROTOCOL.index("\n\n", start)]
    elements = re.findall(r"`([^`]*)`", paragraph)
    found = [name for element in elements for name in names_in(element)]
    assert found[: len(field_names(kind))] == field_names(kind)


@pytest.mark.parametrize("kind", get_args(events.Event), ids=lambda kind: kind.__name__)
def test_events(kind: Any) -> None:
    (row,) = re.findall(rf"^\| `{tag_of(kind)}` \|([^|]*)\|[^|]*\|$", EVENTS, re.MULTILINE)
    elements = re.findall(r"`([^`]*)`", row)
    assert ["seq", "epoch", "unix_ns", *(name for e in elements for name in names_in(e))] == field_names(kind)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("Held", m.HeldCell),
        ("Handle", m.Handle),
        ("Failed", m.FailedCell),
        ("Holder", m.Holder),
        ("Row", m.MetadataRow),
        ("Client", m.ClientRow),
        ("Segment", m.CellRow),
        ("Pinned", m.PinnedCell),
        ("Intent", m.Intent),
        ("LiveMap", live.LiveMapRow),
        ("Chunk", live.LiveChunkRow),
    ],
)
def test_rows(name: str, kind: Any) -> None:
    found = re.search(rf"\*{name}\*(?:\*)? ?(?:is|:)?\**:?\s*`\[(.*?)\]`", PROTOCOL)
    assert found is not None
    assert names_in(found[1]) == field_names(kind)


def test_every_code_is_explained() -> None:
    def tree(root: type[errors.ShmmapError]) -> set[str]:
        return {root.code}.union(*map(tree, root.__subclasses__()))

    for code in tree(errors.CellError) - {"cell_error"}:
        assert re.search(rf"^\| `{code}` \|", PROTOCOL, re.MULTILINE), code
    for code in ("bad_request", "no_session", "protocol_mismatch", "not_permitted", "internal"):
        assert code in tree(errors.ShmmapError)
        assert f"`{code}`" in PROTOCOL


def test_versions() -> None:
    assert PROTOCOL.startswith("# Protocol, version {}.{}\n".format(*m.PROTOCOL_VERSION))
    assert LAYOUT.startswith("# Segment layout, version {}.{}\n".format(*layout.LAYOUT_VERSION))
    assert STATISTICS.startswith(
        "# Statistics segment, layout version {}.{}\n".format(*statistics_layout.LAYOUT_VERSION)
    )


def size_of(text: str) -> int:
    """Bytes of a type as the tables write it: ``u32``, ``4 × u64``, ``u32, u32``, ``16 bytes``."""
    if found := re.fullmatch(r"(\d+) bytes", text):
        return int(found[1])
    if found := re.fullmatch(r"(\d+) × (\w+)", text):
        return int(found[1]) * SIZES[found[2]]
    return sum(SIZES[part.strip()] for part in text.split(","))


def tables(document: str) -> list[list[tuple[int, str]]]:
    """(offset, type) of each row of every table of bytes whose offsets are numbers."""
    found: list[list[tuple[int, str]]] = []
    inside = False
    for line in document.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| offset | type |"):
            found.append([])
            inside = True
        elif inside and line.startswith("|"):
            if cells[0].isdigit() and cells[1]:
                found[-1].append((int(cells[0]), cells[1]))
        else:
            inside = False
    return [table for table in found if len(table) > 1]


@pytest.mark.parametrize(
    ("document", "ends"),
    [
        (LAYOUT, [header.OUTSIDE_AT + 8, layout.COLUMN.size, header.PUBLISH.size]),
        (
            STATISTICS,
            [
                statistics_layout.DESCRIPTIONS_OFFSET,
                statistics_layout.STATE.size,
                statistics_layout.CHANGES.size,
            ],
        ),
    ],
    ids=["segment", "statistics"],
)
def test_tables_of_bytes_have_no_gaps_and_end_where_the_code_does(document: str, ends: list[int]) -> None:
    seen = []
    for table in tables(document):
        expected = 0
        for offset, kind in table:
            assert offset == expected, (offset, kind)
            if "count" in kind:
                break
            expected += size_of(kind)
        seen.append(expected)
    assert seen == ends
