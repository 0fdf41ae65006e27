# SPDX-License-Identifier: Apache-2.0
"""The grammar of the command line: verbs, numbers, areas, which daemon, and what wrong usage prints."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator

import pytest

from shmmap.cli import json_output
from shmmap.cli.areas import area_from
from shmmap.cli.daemon_address import endpoint
from shmmap.cli.daemon_address import instance as instance_of
from shmmap.cli.entry import GROUPS, NUMBER_OPTIONS, VERBS, build_parser, main, verb_first
from shmmap.cli.options import numbers, seconds
from shmmap.cli.program import join_negative_values
from shmmap.cli.verbs.cells.query import held_cell
from shmmap.errors import BadRequest
from shmmap.geometry import AutowareSquare, Box, Circle
from shmmap.protocol.rows import LiveMapRow
from tests.unit.conftest import Verb

CONTRACT = {
    "serve",
    "status",
    "ls",
    "show",
    "clients",
    "view",
    "query",
    "reload",
    "evict",
    "pin",
    "unpin",
    "stop",
    "config",
    "unit",
    "doctor",
    "cpp",
    "completion",
    "inspect",
    "export",
    "demo",
    "health",
    "version",
    "divide",
    "merge",
    "prepare",
    "live",
    "top",
    "tail",
    "map",
    "metrics",
    "publish",
    "versions",
    "fetch",
}


def every_parser(
    parser: argparse.ArgumentParser, words: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], argparse.ArgumentParser]]:
    """Parsers of all verbs and their actions, by their words."""
    yield words, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield from every_parser(below, (*words, name))


def parse(*words: str) -> argparse.Namespace:
    return build_parser().parse_args(join_negative_values(words, NUMBER_OPTIONS))


@pytest.mark.parametrize("verb", sorted(CONTRACT))
def test_every_verb_explains_itself_in_lines_that_fit(
    verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: shmmap {verb}")
    assert [line for line in text.splitlines() if len(line) >= 80] == []
    assert ("--json" in text) == ("fields may be added, none is removed" in text)
    assert ("\n  {" in text) == ("JSON (fields" in text), "its JSON keeps its shape"


def test_help_has_every_verb_under_the_heading_of_its_group(capsys: pytest.CaptureFixture[str]) -> None:
    assert set(VERBS) == CONTRACT
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    for heading, verbs in GROUPS.items():
        first = lines.index(f"{heading}:") + 1
        shown = [line.split()[0] for line in lines[first:] if line.split()[:1] and line.split()[0] in VERBS]
        assert shown[: len(verbs)] == list(verbs)


JSON_VERBS = {
    words: parser.get_default("json_output")
    for words, parser in every_parser(build_parser())
    if parser.get_default("json_output")
}


@pytest.mark.parametrize("words", JSON_VERBS, ids=" ".join)
def test_every_verb_has_a_schema_of_its_json(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever else is missing on the command line; each kind of output with its fields."""
    with pytest.raises(SystemExit) as ended:
        main([*words, "--json-schema"])
    schema = json.loads(capsys.readouterr().out)
    assert (ended.value.code, schema["$schema"].rpartition("/")[2]) == (0, "schema")
    refs = [schema] if "$ref" in schema else schema["anyOf"]
    for ref in refs:
        assert schema["$defs"][ref["$ref"].rpartition("/")[2]]["properties"]


def test_rows_of_the_protocol_are_printed_whole() -> None:
    """What is added to a row of a live map is added to its JSON."""
    assert json_output.LiveMap.__struct_fields__ == LiveMapRow.__struct_fields__


@pytest.mark.parametrize(
    ("words", "circle"),
    [
        (["--circle", "-5,3,40"], [-5.0, 3.0, 40.0]),
        (["--circle=-5,3,40"], [-5.0, 3.0, 40.0]),
        (["--circle", "-5.5,-3e2,40"], [-5.5, -300.0, 40.0]),
        (["--circle", "-.5,3,40"], [-0.5, 3.0, 40.0]),
        (["--circle", "5,-3,40"], [5.0, -3.0, 40.0]),
    ],
)
def test_areas_with_negative_numbers(words: list[str], circle: list[float]) -> None:
    assert parse("query", *words).circle == circle


def test_negative_numbers_are_joined_only_behind_their_options() -> None:
    for words, joined in (
        (["--id", "-5,3"], ["--id", "-5,3"]),
        (["--z", "-2,3", "-1"], ["--z=-2,3", "-1"]),
        (["--circle", "--json"], ["--circle", "--json"]),
    ):
        assert join_negative_values(words, NUMBER_OPTIONS) == joined
    assert join_negative_values(["--guess", "-5,3", "-1"]) == ["--guess=-5,3", "-1"]


@pytest.mark.parametrize(
    "words",
    [
        ["query", "--circle", "1,2"],
        ["query", "--circle", "1,2,x"],
        ["query", "--circle", "1,2,nan"],
        ["query", "--box", "1,2,3"],
        ["query", "--circle", "1,2,3", "--square", "1,2,3"],
        ["query"],
        ["query", "--circ", "1,2,3"],
        ["status", "--timeout", "never"],
        ["nonsense"],
        ["cpp", "--includes", "--cmakedir"],
    ],
)
def test_wrong_usage_exits_2_and_hints_at_help(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.out == ""
    complaint, hint = said.err.splitlines()
    assert complaint.startswith("shmmap")
    assert hint.startswith("hint: shmmap")
    assert hint.endswith("--help")


@pytest.mark.parametrize(
    ("words", "complaint", "hint"),
    [
        (["statuss"], "shmmap: there is no verb 'statuss'; did you mean status?", "shmmap --help"),
        (
            ["config", "chekc"],
            "shmmap config: there is no action 'chekc'; did you mean check?",
            "shmmap config --help",
        ),
        (
            ["status", "--jsno"],
            "shmmap status: unknown option --jsno; did you mean --json?",
            "shmmap status --help",
        ),
        (["status", "extra"], "shmmap status: unexpected argument: extra", "shmmap status --help"),
        (
            ["query", "--circel", "1,2,3"],
            "shmmap query: unknown option --circel; did you mean --circle?",
            "shmmap query --help",
        ),
        (
            ["export", "--circle", "1,2,3", "--outptu", "x.pcd"],
            "shmmap export: unknown option --outptu; did you mean --output?",
            "shmmap export --help",
        ),
    ],
)
def test_what_is_misspelt_is_refused_by_its_verb_with_a_suggestion(
    words: list[str], complaint: str, hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"{complaint}\nhint: {hint}\n"


def test_without_a_verb_all_are_listed(verb: Verb) -> None:
    said = verb([], 2)
    assert said.out == ""
    assert all(f"\n    {verb} " in said.err for verb in CONTRACT)
    assert "Exit codes" in said.err


def test_area_from_options() -> None:
    assert area_from(parse("query", "--circle", "1,2,3")) == Circle(1, 2, 3)
    assert area_from(parse("query", "--square", "1,2,3", "--z", "-4,5")) == AutowareSquare(1, 2, 3, (-4, 5))
    assert area_from(parse("query", "--box", "-1,-2,3,4")) == Box(-1, -2, 3, 4)
    assert area_from(parse("query", "--id", "a")) is None
    with pytest.raises(BadRequest, match="--z needs an area"):
        area_from(parse("query", "--id", "a", "--z", "0,1"))


def test_numbers_and_seconds() -> None:
    assert numbers("-1,2e3", "A,B") == [-1.0, 2000.0]
    assert seconds("0.5") == 0.5
    for text in ("-1", "inf", "nan", "1e300", "x", ""):
        with pytest.raises(argparse.ArgumentTypeError):
            seconds(text)


def test_common_options_may_stand_before_the_verb() -> None:
    assert verb_first(["--endpoint", "/x", "--json", "status"]) == ["status", "--endpoint", "/x", "--json"]
    assert verb_first(["--timeout=3", "query", "--id", "a"]) == ["query", "--timeout=3", "--id", "a"]
    for words in (["status", "--json"], ["--help"], ["--version"], ["--json"], ["--endpoint"], []):
        assert verb_first(words) == words


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("evict", "evict: give cells, an area or --all\nhint: shmmap evict --help\n"),
        (
            "unpin --all 0_0.pcd",
            "unpin: give only one of: cells, an area or --all\nhint: shmmap unpin --help\n",
        ),
        ("pin --circle 1,2,3 0_0.pcd", "pin: give only one of: cells or an area\nhint: shmmap pin --help\n"),
        ("query --circle 1,2,-3", "circle: radius must not be negative"),
        ("query --box 3,0,1,1", "box: need min <= max"),
        ("query --circle 1,inf,3", "circle: y must be a finite number"),
        ("query --id a --z 0,1", "--z needs an area"),
        ("query --id a --held b", "--held needs an area"),
        ("query --circle 0,0,5 --held a@xyz", "--held: 'a@xyz' is not ID@VERSION"),
        ("prepare . --layer points --cache-size 0", "--cache-size 0 keeps no layer"),
    ],
)
def test_what_makes_no_sense_exits_2(words: str, says: str, verb: Verb) -> None:
    said = verb(words.split(), 2)
    assert said.out == ""
    assert said.err.startswith(f"shmmap: {says}")


VARIABLES = {
    "SHMMAP_ENDPOINT": "/v/one.sock",
    "SHMMAP_INSTANCE": "two",
    "SHMMAP_RUNTIME_DIR": "/v/dir",
}


@pytest.mark.parametrize(
    ("flags", "variables", "socket", "name"),
    [
        ([], [], None, "default"),
        ([], ["SHMMAP_ENDPOINT"], "/v/one.sock", "one"),
        ([], ["SHMMAP_INSTANCE"], "/x/shmmap/two.sock", "two"),
        ([], ["SHMMAP_INSTANCE", "SHMMAP_RUNTIME_DIR"], "/v/dir/two.sock", "two"),
        (["--endpoint", "/f/three.sock"], [*VARIABLES], "/f/three.sock", "three"),
        (["--instance", "four"], [*VARIABLES], "/v/dir/four.sock", "four"),
        (["--instance", "four"], ["SHMMAP_ENDPOINT"], "/x/shmmap/four.sock", "four"),
        (["--instance", "default"], ["SHMMAP_ENDPOINT"], "/x/shmmap/default.sock", "default"),
        (["--runtime-dir", "/f"], [*VARIABLES], "/f/two.sock", "two"),
        (["--endpoint", "/f/three.sock", "--instance", "four"], [], "/f/three.sock", "four"),
    ],
)
def test_flags_count_before_variables(
    flags: list[str],
    variables: list[str],
    socket: str | None,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for variable, value in VARIABLES.items():
        monkeypatch.delenv(variable, raising=False)
        if variable in variables:
            monkeypatch.setenv(variable, value)
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/x")
    args = build_parser().parse_args(["clients", *flags])
    assert (endpoint(args), instance_of(args)) == (socket, name)


@pytest.mark.parametrize(
    ("text", "held"),
    [
        ("cell.pcd", "cell.pcd"),
        ("cell.pcd@1f", ("cell.pcd", 0x1F)),
        ("/maps/a@b/cell.pcd", "/maps/a@b/cell.pcd"),
        ("/maps/a@b/cell@2.pcd", "/maps/a@b/cell@2.pcd"),
        ("/maps/a@b/cell.pcd@ffffffffffffffff", ("/maps/a@b/cell.pcd", (1 << 64) - 1)),
        ("cell@c0ffee", ("cell", 0xC0FFEE)),
    ],
)
def test_held(text: str, held: str | tuple[str, int]) -> None:
    assert held_cell(text) == held


@pytest.mark.parametrize(
    "text", ["cell.pcd@", "@1f", "cell.pcd@xyz", "cell.pcd@1ffffffffffffffff", "cell.pcd@-1"]
)
def test_not_held(text: str) -> None:
    with pytest.raises(BadRequest, match="--held"):
        held_cell(text)
