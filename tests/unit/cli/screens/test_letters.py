# SPDX-License-Identifier: Apache-2.0
"""Names of any script stand in their columns, and none ends a program whose terminal lacks its letters."""

from __future__ import annotations

import io
import json

import pytest

from shmmap.cli.program import exit_code_of
from shmmap.cli.screens.letters import columns_of, cut, folded, padded
from shmmap.cli.screens.output import Column, print_json, print_line, print_table
from tests.unit.cli.screens.conftest import Terminal

WIDE, ACCENTS = "規劃器", "e\u0301" * 3


@pytest.mark.parametrize(("text", "columns"), [("abc", 3), ("é", 1), (WIDE, 6), (ACCENTS, 3), ("", 0)])
def test_columns(text: str, columns: int) -> None:
    assert columns_of(text) == columns
    for align in ("left", "right"):
        assert columns_of(padded(text, 9, align)) == 9
    for room in range(10):
        assert columns_of(cut(text, room)) <= room
        assert text.startswith(cut(text, room))
        assert "".join(folded(text, room)) == text
    assert cut(text, columns) == text


def test_a_table_is_aligned_and_no_wider_than_the_terminal(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout", terminal)
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("NO_COLOR", "1")
    columns = (Column("CLIENT"), Column("CELLS", "right"))
    print_table(columns, [[WIDE * 10, "1"], [ACCENTS, "22"], ["plain", "333"]])
    lines = terminal.getvalue().splitlines()
    assert max(map(columns_of, lines)) <= 40
    numbered = [line for line in lines if line[-1] in "S123"]
    assert len(numbered) == 4
    assert len({columns_of(line) for line in numbered}) == 1


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "euc-jp"])
def test_an_encoding_without_the_letters(monkeypatch: pytest.MonkeyPatch, encoding: str) -> None:
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, encoding=encoding, errors="strict"))

    def program() -> int:
        print_line("█ \N{GRINNING FACE} end")
        print_json({"name": f"{WIDE} \N{GRINNING FACE}"})
        return 0

    assert exit_code_of("shmmap", program) == 0
    first, second = written.getvalue().decode(encoding).splitlines()
    assert first.endswith("? end")
    assert json.loads(second) == {"name": f"{WIDE} \N{GRINNING FACE}"}
