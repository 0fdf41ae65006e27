# SPDX-License-Identifier: Apache-2.0
"""Text for people, JSON for programs."""

from __future__ import annotations

import itertools
import json
import re

import pytest

from shmmap.cli.screens.output import (
    Column,
    columns_that_fit,
    format_bytes,
    format_duration,
    print_json,
    print_pairs,
    print_table,
)
from shmmap.cli.verbs.live.served import _CHUNK_COLUMNS
from shmmap.cli.verbs.look.status import _CLIENT_COLUMNS
from tests.unit.cli.screens.conftest import Terminal

COLUMNS = (Column("CELL"), Column("POINTS", "right"))
ROWS = [["0_0.pcd", "7"], ["[red]20_0.pcd", "1,234"]]


def test_plain_table_is_aligned(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(COLUMNS, ROWS)
    assert capsys.readouterr().out == (
        "CELL           POINTS\n"
        "0_0.pcd             7\n"
        "[red]20_0.pcd   1,234\n"
    )  # fmt: skip


def test_table_on_a_terminal_is_styled_unless_the_environment_forbids_it(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout", terminal)
    print_table(COLUMNS, ROWS)
    assert "\x1b[1m" in terminal.getvalue()
    assert "[red]20_0.pcd" in terminal.getvalue(), "names are no markup"
    for name, value in (("NO_COLOR", "1"), ("TERM", "dumb")):
        with monkeypatch.context() as changed:
            changed.setenv(name, value)
            changed.setattr("sys.stdout", terminal := Terminal())
            print_table(COLUMNS, ROWS)
            assert "\x1b" not in terminal.getvalue()


WIDE = (Column("CELL"), Column("X", "right", spare=1), Column("Y", "right", spare=1), Column("ID", spare=2))
WIDE_ROWS = [["town_0_0.pcd", "100", "200", "0123456789abcdef"]]


def test_chunks_of_each_state_have_a_colour(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", terminal)
    states = ("clean", "dirty", "saving", "loading", "saved")
    print_table(_CHUNK_COLUMNS, [["0_0_0", *["1"] * 3, state, *["1"] * 5] for state in states])
    for state in states:
        assert re.search(rf"\x1b\[[0-9]+m{state} *\x1b\[0m", terminal.getvalue()), state


@pytest.mark.parametrize(
    ("columns", "names"),
    [(40, ["CELL", "X", "Y", "ID"]), (39, ["CELL", "X", "Y"]), (22, ["CELL", "X", "Y"]), (21, ["CELL"])],
)
def test_a_narrow_terminal_goes_without_spare_columns(columns: int, names: list[str]) -> None:
    assert [WIDE[index].name for index in columns_that_fit(WIDE, WIDE_ROWS, columns)] == names


def test_a_wide_column_takes_no_other_with_it() -> None:
    columns = (Column("CELL"), Column("LAYER", spare=1), Column("X", "right", spare=2))
    rows = [["town_0_0.pcd", "voxel(leaf=0.5,of=crop(z_max=12.0))", "100"]]
    assert columns_that_fit(columns, rows, 30) == [0, 2]
    assert columns_that_fit(columns, rows, 52) == [0, 1]


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize(
    "name", ["localization", "perception_of_the_front_left_camera_and_the_lidar_behind_it_no_1"]
)
@pytest.mark.parametrize("width", [40, 80, 120])
def test_clients_on_any_terminal(monkeypatch: pytest.MonkeyPatch, width: int, name: str) -> None:
    """A long name is folded before columns go; what matters most stays."""
    row = [
        name,
        "15230",
        "operator",
        "1,234",
        "728 KiB",
        "572 KiB",
        "-",
        "12,345",
        "20.5 s",
        "-100.5,90.1",
        "python3",
    ]
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr("sys.stdout", terminal := Terminal())
    print_table(_CLIENT_COLUMNS, [row])
    lines = re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue()).splitlines()
    assert max(len(line) for line in lines if "hidden" not in line) <= width
    assert lines[0].split()[0] == "CLIENT"
    assert {"GIVEN"} <= set(lines[0].split())
    if width >= 80:
        assert {"PID", "CELLS", "GIVEN", "MAPPED", "OUTDATED"} <= set(lines[0].split())
    table = itertools.takewhile(lambda line: not line.startswith("hidden"), lines[1:])
    assert "".join(line.split()[0] for line in table) == name


@pytest.mark.usefixtures("terminal")
def test_a_table_is_never_wider_than_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A name is folded only where no column is left to leave out."""
    for width in range(24, 60):
        monkeypatch.setenv("COLUMNS", str(width))
        monkeypatch.setattr("sys.stdout", terminal := Terminal())
        print_table(WIDE, WIDE_ROWS)
        assert "town_0_0.pcd" in terminal.getvalue(), f"folded at {width} columns"


def test_a_narrow_terminal_shows_what_is_missing(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", terminal)
    monkeypatch.setenv("COLUMNS", "21")
    print_table(WIDE, WIDE_ROWS)
    assert "town_0_0.pcd" in terminal.getvalue()
    *_, first, second = terminal.getvalue().splitlines()
    assert "hidden (narrow" in first
    assert "terminal): X, Y, ID" in second
    assert "100" not in terminal.getvalue()


def test_long_pairs_go_on_below_themselves_on_a_terminal(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout", terminal)
    monkeypatch.setenv("COLUMNS", "30")
    print_pairs([("loads", "16 done, 0 queued, 0 failed"), ("map", "/a/path/longer/than/the/line")])
    assert terminal.getvalue() == (
        "loads  16 done, 0 queued, 0\n"
        "       failed\n"
        "map    /a/path/longer/than/the/line\n"
    )  # fmt: skip


def test_pairs(capsys: pytest.CaptureFixture[str]) -> None:
    print_pairs([("map", "town"), ("cells", "300"), ("note", "")])
    assert capsys.readouterr().out == "map    town\ncells  300\nnote\n"


def test_json_is_one_document_and_refuses_nan(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"a": [1, 2.5], "b": "ü"})
    text = capsys.readouterr().out
    assert json.loads(text) == {"a": [1, 2.5], "b": "ü"}
    assert text.count("\n") == 1
    with pytest.raises(ValueError, match="JSON"):
        print_json(float("nan"))


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"), (1023, "1023 B"), (1024, "1.0 KiB"), (99.9 * 1024, "99.9 KiB"), (99.96 * 1024, "100 KiB"),
        (1023.4 * 1024, "1023 KiB"), (1023.6 * 1024, "1.0 MiB"), (200 << 20, "200 MiB"), (3 << 29, "1.5 GiB"),
        (7 << 40, "7168 GiB"),
    ],
)  # fmt: skip
def test_bytes(count: float, text: str) -> None:
    assert format_bytes(count) == text


@pytest.mark.parametrize(
    ("duration_s", "text"),
    [
        (0.0, "0 us"), (12e-6, "12 us"), (3.4e-3, "3.4 ms"), (0.9996, "1.0 s"), (5, "5.0 s"), (180, "3 min"),
        (7200, "2 h"), (3 * 86400, "3 d"),
    ],
)  # fmt: skip
def test_durations(duration_s: float, text: str) -> None:
    assert format_duration(duration_s) == text
