# SPDX-License-Identifier: Apache-2.0
"""A name from elsewhere writes nothing to the terminal but its letters."""

from __future__ import annotations

import ast
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest

import shmmap.cli
from shmmap.cli.program import complain
from shmmap.cli.screens.output import (
    Column,
    json_text,
    print_json,
    print_line,
    print_pairs,
    print_table,
    printable,
)
from shmmap.cli.screens.picture import CellSquare, Vehicle, top_view_svg
from shmmap.cli.verbs.look.tail import _print_text
from tests.unit.cli.screens.conftest import Terminal

HOSTILE = "a\x1b]0;owned\x07\r\n\x9b2J\u202e\udcff\u2028\x00z"


def harmless(text: str) -> bool:
    return all(one.isprintable() for line in text.split("\n") for one in line)


def test_letters_stay_and_codes_are_shown() -> None:
    assert printable("Straße – 0_0.pcd…") == "Straße – 0_0.pcd…"
    assert printable("a\x1b[2Jb\n") == "a\\x1b[2Jb\\n"
    assert harmless(printable(HOSTILE))
    assert "\n" not in printable(HOSTILE)


def test_whatever_prints_escapes(capsys: pytest.CaptureFixture[str]) -> None:
    print_line(HOSTILE)
    print_pairs([("client", HOSTILE)])
    print_table((Column("CLIENT"), Column("COMMAND")), [[HOSTILE, HOSTILE]])
    complain("shmmap", HOSTILE, HOSTILE)
    shown = capsys.readouterr()
    assert harmless(shown.out)
    assert harmless(shown.err)
    assert (shown.out.count("owned"), shown.err.count("owned")) == (4, 2)
    assert shown.out.count("\n") == 4


def test_tables_and_lines_on_a_terminal(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", terminal)
    print_table((Column("CLIENT"),), [[HOSTILE]])
    print_pairs([("client", HOSTILE)])
    assert "\x1b]0;" not in terminal.getvalue()
    assert "\x07" not in terminal.getvalue()
    assert "\x9b" not in terminal.getvalue()


def test_json_is_what_was_given_and_harmless(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({HOSTILE: [HOSTILE, 1]})
    text = capsys.readouterr().out
    assert harmless(text)
    assert json.loads(text) == {HOSTILE: [HOSTILE, 1]}
    assert json.loads(json_text({"a": HOSTILE, "ü": "\U000e0001"}, indent=2)) == {
        "a": HOSTILE,
        "ü": "\U000e0001",
    }


def test_events(capsys: pytest.CaptureFixture[str]) -> None:
    from shmmap.protocol.events import Joined

    fields: dict[str, Any] = dict.fromkeys(Joined.__struct_fields__, 0)
    _print_text(Joined(**{**fields, "client": HOSTILE}))
    shown = capsys.readouterr().out
    assert harmless(shown)
    assert "owned" in shown


def test_pictures_stay_xml() -> None:
    vehicle = Vehicle(1.0, 1.0, None, 0.0, HOSTILE, HOSTILE)
    drawn = top_view_svg(
        (0.0, 0.0, 2.0, 2.0), [CellSquare((0.0, 0.0, 1.0, 1.0), "", HOSTILE)], title=HOSTILE, others=[vehicle]
    )
    assert "owned" in "".join(ElementTree.fromstring(drawn).itertext())


def test_verbs_print_through_the_one_place() -> None:
    """Only `screens/output` calls ``print``."""
    root = Path(shmmap.cli.__file__).parent
    for path in root.rglob("*.py"):
        if path.name == "output.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "print", f"{path}:{node.lineno}"
