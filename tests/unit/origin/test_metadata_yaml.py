# SPDX-License-Identifier: Apache-2.0
"""Metadata files in the dialects that exist, by the fast reader and by the YAML parser."""

from __future__ import annotations

import random
import re

import numpy as np
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shmmap.errors import MapDataError, MapMissing
from shmmap.origin import metadata as metadata_module
from shmmap.origin.metadata import EntryCollector, MapMetadata, collect_lines, metadata_bytes, parse_metadata

HEAD = "x_resolution: 20.0\ny_resolution: 20.0\n"


def contents(metadata: MapMetadata) -> dict[str, tuple[float, float]]:
    corners = [(x, y) for x, y in metadata.corners.tolist()]
    return dict(zip([name.decode() for name in metadata.names.tolist()], corners, strict=True))


def read(text: str, *, strict: bool = False) -> MapMetadata:
    """Parse with both readers and require the same result."""
    data = text.encode()
    quick = parse_metadata(data, path="m.yaml", strict=strict)
    slow = parse_metadata(data, path="m.yaml", strict=strict, lines=False)
    assert contents(quick) == contents(slow)
    assert (quick.x_resolution, quick.y_resolution) == (slow.x_resolution, slow.y_resolution)
    assert quick.problems == slow.problems
    return quick


def is_quick(text: str) -> bool:
    return collect_lines(text.encode(), EntryCollector(strict=False))


def test_the_divider_s_own_form() -> None:
    metadata = read(HEAD + "town_1200_2500.pcd: [1200, 2500]\ntown_-20_0.pcd: [-20, 0]\n")
    assert contents(metadata) == {"town_1200_2500.pcd": (1200.0, 2500.0), "town_-20_0.pcd": (-20.0, 0.0)}
    assert (metadata.x_resolution, metadata.y_resolution) == (20.0, 20.0)
    assert metadata.problems == ()


@pytest.mark.parametrize(
    "text",
    [
        "a.pcd: [1, 2]\n" + HEAD,
        "a.pcd: [1, 2]\nx_resolution: 20\ny_resolution: 20",
        HEAD.replace("\n", "\r\n") + "a.pcd: [1, 2]\r\n",
        "# made by hand\n\n" + HEAD + "   \na.pcd: [1, 2] # the first\n# end",
        HEAD + "a.pcd:   [ 1 ,2  ]   \n",
        HEAD + "'a.pcd': [1, 2]\n",
        HEAD + '"a.pcd": [+1, 2]\n',
        "---\n" + HEAD + "a.pcd: [1, 2]\n",
        "\ufeff" + HEAD + "a.pcd: [1, 2]\n",
        HEAD.replace("20.0", "2e1") + "a.pcd: [1, 2]\n",
        HEAD + "a.pcd: [0x1, 02]\n",
    ],
)
def test_dialects_read_without_the_parser(text: str) -> None:
    assert contents(read(text)) == {"a.pcd": (1.0, 2.0)}
    assert is_quick(text)


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "a.pcd:\n  - 1\n  - 2\n",
        HEAD + "a.pcd:\n- 1\n- 2\n",
        HEAD + "a.pcd: [\"1\", '2']\n",
        HEAD + "a.pcd: [1,\n  2]\n",
        HEAD + "? a.pcd\n: [1, 2]\n",
        HEAD + "a.pcd: !!seq [1, 2]\n",
        HEAD + "  # indented comment\na.pcd: [1, 2]\n",
        "{x_resolution: 20.0, y_resolution: 20.0, a.pcd: [1, 2]}",
        "%YAML 1.1\n---\n" + HEAD + "a.pcd: [1, 2]\n...\n",
        HEAD + "a.pcd: [1, 2]\n---\nb.pcd: [3, 4]\n",
        HEAD + "\ta.pcd: [1, 2]\n".replace("\t", "") + "\n\n# tail",
        '"x_resolution": "20.0"\ny_resolution: \'20.0\'\n"\\x61.pcd": [1, 2]\n',
    ],
)
def test_dialects_that_may_need_the_parser(text: str) -> None:
    assert contents(read(text)) == {"a.pcd": (1.0, 2.0)}


def test_names_that_yaml_could_take_for_something_else() -> None:
    names = [
        "1.pcd",
        "-5_7.pcd",
        "_0_20.pcd",
        "null",
        "1e3",
        "0x10",
        "yes",
        ".pcd",
        "+1.pcd",
        "a=b.pcd",
        "a(1).pcd",
        "x/y.pcd",
    ]
    text = HEAD + "".join(f"{name}: [{i}, {-i}]\n" for i, name in enumerate(names))
    assert contents(read(text)) == {name: (float(i), float(-i)) for i, name in enumerate(names)}


def test_names_outside_ascii_and_with_spaces() -> None:
    text = HEAD + 'a b.pcd: [1, 2]\n"c d.pcd": [3, 4]\n地図_0_20.pcd: [0, 20]\n'
    assert contents(read(text)) == {
        "a b.pcd": (1.0, 2.0),
        "c d.pcd": (3.0, 4.0),
        "地図_0_20.pcd": (0.0, 20.0),
    }


def test_float_corners_are_read_and_reported() -> None:
    metadata = read(HEAD + "a.pcd: [12.5, -7.25]\nb.pcd: [1200.0, 1e2]\nc.pcd: [1, 2]\n")
    assert contents(metadata) == {"a.pcd": (12.5, -7.25), "b.pcd": (1200.0, 100.0), "c.pcd": (1.0, 2.0)}
    (problem,) = metadata.problems
    assert "not an integer" in problem
    assert "a.pcd, b.pcd" in problem
    assert "c.pcd" not in problem


@pytest.mark.parametrize("corner", ["12.5, 1", "1200.0, 1", "1, 1e2", "2147483648, 0", ".5, 1"])
def test_strict_refuses_what_autoware_s_loader_refuses(corner: str) -> None:
    text = HEAD + f"ok.pcd: [1, 2]\na.pcd: [{corner}]\n"
    with pytest.raises(
        MapDataError, match=r"m\.yaml: line 4: a\.pcd: the corner must be two integers"
    ) as caught:
        parse_metadata(text.encode(), path="m.yaml", strict=True)
    assert caught.value.offset == text.index("a.pcd: [" + corner)
    assert caught.value.cause == "bad_corner"
    assert contents(read(text))["ok.pcd"] == (1.0, 2.0)


def test_unknown_keys_are_reported_and_in_strict_mode_refused() -> None:
    text = HEAD + "z_resolution: 5\nauthor: mapper\nnested: {a: [1, 2], b: {c: d}}\nempty:\na.pcd: [1, 2]\n"
    metadata = read(text)
    assert contents(metadata) == {"a.pcd": (1.0, 2.0)}
    (problem,) = metadata.problems
    assert problem == "unknown key ignored: z_resolution, author, nested, ... (4 in all)"
    with pytest.raises(MapDataError, match=r"line 3: z_resolution is not an \[x, y\] corner") as caught:
        parse_metadata(text.encode(), path="m.yaml", strict=True)
    assert caught.value.cause == "unknown_key"


def test_a_third_value_is_ignored_as_autoware_does() -> None:
    metadata = read(HEAD + "a.pcd: [1, 2, 3]\n", strict=True)
    assert contents(metadata) == {"a.pcd": (1.0, 2.0)}
    assert metadata.problems == ("values after x and y ignored: a.pcd",)


def test_the_last_of_repeated_entries_counts() -> None:
    metadata = read(HEAD + "a.pcd: [1, 2]\nb.pcd: [5, 6]\na.pcd: [3, 4]\n")
    assert contents(metadata) == {"b.pcd": (5.0, 6.0), "a.pcd": (3.0, 4.0)}
    assert metadata.problems == ("repeated entry, the last one counts: a.pcd",)


@pytest.mark.parametrize(
    ("text", "message", "cause"),
    [
        ("", "x_resolution and y_resolution missing", "no_resolution"),
        ("x_resolution: 1\na.pcd: [1, 2]\n", "y_resolution missing", "no_resolution"),
        ("x_resolution: 0\ny_resolution: 1\n", "line 1: x_resolution must be a positive", "no_resolution"),
        ("x_resolution: -5\ny_resolution: 1\n", "positive", "no_resolution"),
        ("x_resolution: .inf\ny_resolution: 1\n", "positive", "no_resolution"),
        ("x_resolution: nan\ny_resolution: 1\n", "positive", "no_resolution"),
        ("x_resolution: 1e308\ny_resolution: 1\n", r"metres, not '1e308' \(below 1e.12 m\)", "no_resolution"),
        (HEAD + "a.pcd: [1e13, 2]\n", r"two numbers, not \[1e13, 2\] \(below 1e.12 m\)", "bad_corner"),
        (HEAD + "a.pcd: [9" + 60 * "0" + ", 2]\n", "the corner must be two numbers", "bad_corner"),
        ("x_resolution: [1, 2]\ny_resolution: 1\n", "corner", "bad_corner"),
        (HEAD + "a.pcd: [1]\n", "line 3: a.pcd needs two values", "bad_corner"),
        (HEAD + "a.pcd: []\n", "line 3: a.pcd needs two values", "bad_corner"),
        (HEAD + "a.pcd: [x, 2]\n", r"two numbers, not \[x, 2\]", "bad_corner"),
        (HEAD + "a.pcd: [.nan, 2]\n", "two numbers", "bad_corner"),
        (HEAD + "a.pcd: [.inf, 2]\n", "two numbers", "bad_corner"),
        (HEAD + "a.pcd: [1e999, 2]\n", "two numbers", "bad_corner"),
        (HEAD + "a.pcd: [1_0, 2]\n", "two numbers", "bad_corner"),
        (HEAD + "a.pcd: [089, 2]\n", "", ""),
        (HEAD + f"a.pcd: [{'9' * 10_000}, 2]\n", "two numbers, not .9999.*10,000 characters", "bad_corner"),
        (HEAD + f"{'a' * 900}.pcd: [1, 2]\n", "aaa.*904 characters.*so long a name", "bad_corner"),
        (HEAD + "a.pcd: [1, 2\nb.pcd: [3, 4]\n", "line 4: no YAML", "bad_yaml"),
        (HEAD + "a.pcd: [1, 2]]\n", "no YAML", "bad_yaml"),
        ("%TAG !a! b\n---\n" + HEAD, "tag directives are not read .at byte 0", "bad_yaml"),
        (HEAD + "a.pcd: *b\n", "line 3: aliases", "bad_yaml"),
        (HEAD + "[a, b]: [1, 2]\n", "line 3: a key must be a name", "bad_yaml"),
        ("- a\n- b\n", "not a YAML mapping", "bad_yaml"),
        ("just text\n", "not a YAML mapping", "bad_yaml"),
        (HEAD + "a.pcd: [1, 2]\n\x00", "no YAML", "bad_yaml"),
        (HEAD + "a.pcd: " + "[" * 100_000, "line 3: nested too deeply", "bad_yaml"),
    ],
)
def test_refusals_name_file_line_and_cause(text: str, message: str, cause: str) -> None:
    if not cause:  # odd, but a number
        assert contents(read(text)) == {"a.pcd": (89.0, 2.0)}
        return
    with pytest.raises(MapDataError, match=message) as caught:
        parse_metadata(text.encode(), path="some/m.yaml")
    assert caught.value.cause == cause
    assert caught.value.path == "some/m.yaml"
    assert str(caught.value).startswith("some/m.yaml: ")


def test_a_problem_is_short_however_long_the_key() -> None:
    (problem,) = read(HEAD + "? " + "k" * 100_000 + "\n: 1\na.pcd: [1, 2]\n").problems
    assert problem.startswith("unknown key ignored: kkk")
    assert len(problem) < 200


def test_a_long_line_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """To look for a line that can be read at each of its places takes time by the square of its length."""
    looked: list[int] = []
    pattern = metadata_module._LINE

    class Counted:
        def match(self, block: bytes, position: int) -> re.Match[bytes] | None:
            looked.append(position)
            return pattern.match(block, position)

    monkeypatch.setattr(metadata_module, "_LINE", Counted())
    assert not is_quick(HEAD + "n" * 10_000)
    assert looked == [0, 19, 38]


def test_bytes_that_are_no_text() -> None:
    with pytest.raises(MapDataError, match="no YAML"):
        parse_metadata(HEAD.encode() + b"\xff\xfe: [1, 2]\n", path="m.yaml")


def test_a_missing_file(tmp_path: object) -> None:
    with pytest.raises(MapMissing, match="No such file"):
        metadata_bytes(f"{tmp_path}/none.yaml")


def test_ten_thousand_entries_quick_equals_parser_equals_pyyaml() -> None:
    rng = random.Random(7)
    lines = [
        f"city_{x}_{y}.pcd: [{x}, {y}]" for x in range(88_000, 90_000, 20) for y in range(-1000, 1000, 20)
    ]
    rng.shuffle(lines)
    lines.insert(0, "x_resolution: 20")
    lines.append("y_resolution: 20")
    text = "\n".join(lines) + "\n"
    assert is_quick(text)
    truth = {k: tuple(map(float, v)) for k, v in yaml.safe_load(text).items() if isinstance(v, list)}
    assert len(truth) == 10_000
    assert contents(read(text)) == truth
    assert [n.decode() for n in read(text).names.tolist()] == list(truth)
    spaced = text.replace(": [", ":  [ ")
    assert is_quick(spaced)
    assert contents(parse_metadata(spaced.encode(), path="m.yaml")) == truth


WORDS = (
    """a b.pcd _1 - : [ ] , [1,2] 0 7 12 -3 +4 1.5 00 08 0x1F # ' " { } &x *x !t | > ~ ... --- % @ ` ? << ="""
)
SPACED = [" ", "  ", ": [", ", ", "[1, 2]", " # c", "? ", "- ", "\n", "\r\n", "\t", "y_resolution: 3"]
ODD = ["\x00", "\x85", "\u2028", "é"]
pieces = st.sampled_from([*WORDS.split(" "), *SPACED, *ODD])


@example(["#\x00"])
@given(st.lists(st.lists(pieces, max_size=8).map("".join), max_size=6))
@settings(max_examples=400, deadline=None)
def test_what_the_fast_reader_accepts_means_the_same_to_the_parser(lines: list[str]) -> None:
    data = (HEAD + "\n".join(lines)).encode()
    for strict in (False, True):
        if not collect_lines(data, EntryCollector(strict)):
            continue
        quick = parse_metadata(data, path="m", strict=strict)
        slow = parse_metadata(data, path="m", strict=strict, lines=False)
        assert contents(quick) == contents(slow)
        assert np.array_equal(quick.names, slow.names)
        assert quick.problems == slow.problems
        assert (quick.x_resolution, quick.y_resolution) == (slow.x_resolution, slow.y_resolution)


VALUES = (
    "[1, 2]|[1,2]|[ 1 , -2 ]|[-0, 00]|[1.5, 2]|[1, 2, 3]|5||[+1,0x1f]|[1e2, 010]|[a, b]|[.5, 5.]|yes|[1-2,3]"
)
line_like = st.tuples(
    st.sampled_from(["a", "b.pcd", "_1_2.pcd", "-5", "'q r'", '"q r"', "z_resolution", "é"]),
    st.sampled_from([":", ": ", ":  ", " : "]),
    st.sampled_from(VALUES.split("|")),
    st.sampled_from(["", " ", " # c", "#c", "\r"]),
).map("".join)


def outcome(data: bytes, *, strict: bool, lines: bool) -> object:
    try:
        metadata = parse_metadata(data, path="m", strict=strict, lines=lines)
    except MapDataError as error:
        return str(error)
    return contents(metadata), metadata.problems


@given(st.lists(line_like, max_size=8))
@settings(max_examples=400, deadline=None)
def test_likely_lines_mean_the_same_to_both_readers(lines: list[str]) -> None:
    data = (HEAD + "\n".join(lines)).encode()
    for strict in (False, True):
        assert outcome(data, strict=strict, lines=True) == outcome(data, strict=strict, lines=False)
