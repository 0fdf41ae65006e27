# SPDX-License-Identifier: Apache-2.0
"""What `top` and `map` draw, from numbers made up here."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser

import msgspec
import pytest
from msgspec.structs import replace

from shmmap.chunks.voxels import ChunkKey
from shmmap.cli.screens.map_scene import GLYPHS, Scene, chunk_squares, html_page, svg, terminal_rows
from shmmap.cli.screens.status_parts import prepare_words, status_lines
from shmmap.cli.screens.top_screen import budget_parts, screen
from shmmap.cli.verbs.look.outputs import Prefetching
from shmmap.client.live.chunk_reader import ChunkInfo
from shmmap.doctor.verdicts import problems
from shmmap.protocol.rows import CellRow, CellState, LiveMapRow, Window
from shmmap.statistics.counters import BUCKETS, HISTOGRAMS
from shmmap.statistics.reader import Snapshot
from tests.support.made_statistics import CLIENT, FULL, IDENTITY, MIB, counters, snapshot


def text(found: Snapshot, *, width: int = 100) -> str:
    lines = screen(found, IDENTITY, width=width)
    return "\n".join("".join(piece for piece, _ in line) for line in lines)


def test_the_budget_is_split_without_a_rest() -> None:
    parts = budget_parts(FULL)
    assert parts == {
        "in_use": 40 * MIB, "idle": 20 * MIB, "retired": 10 * MIB, "loading": 4 * MIB, "statistics": MIB,
        "free": 25 * MIB,
    }  # fmt: skip
    crowded = counters(budget_bytes=MIB, bytes_resident=MIB, bytes_pinned=5 * MIB, bytes_statistics=MIB)
    assert budget_parts(crowded)["free"] == 0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, ""),
        ({"prepare_failed": 3}, ", 3 cannot be made: the log names them"),
        (
            {"prepare_failed": 3, "prepare_retries": 2},
            ", 3 cannot be made: the log names them (2 will be tried again: the loader was killed)",
        ),
        ({"prepare_short": 1}, "; no more: --cache-size is too small for them"),
        (
            {"prepare_short": 2},
            "; waiting: the cache directory is full or cannot be written",
        ),
    ],
)
def test_status_says_how_far_the_prepared_layers_are(values: dict[str, int], words: str) -> None:
    found = counters(prepare_cells=4000, prepare_done=1200, **values)
    assert prepare_words(found, "ndt(leaf=2.0)") == f"ndt(leaf=2.0): 1,200 of 4,000 cells{words}"
    assert prepare_words(found, "") == ""


@pytest.mark.parametrize("width", [40, 80, 100, 250])
def test_the_bar_is_as_long_as_there_is_room(width: int) -> None:
    lines = text(snapshot(FULL, []), width=width).splitlines()
    bar = next(line for line in lines if "██" in line).removeprefix("memory").strip()
    assert len(bar) == width - 14
    assert [bar.count(glyph) for glyph in "█▓▒░·"] == pytest.approx(
        [share * len(bar) for share in (0.4, 0.2, 0.1, 0.05, 0.25)], abs=1.0
    )


def test_the_screen_answers_what_an_operator_asks() -> None:
    shown = text(snapshot(FULL, [CLIENT]))
    for piece in (
        "healthy", "pid 77", "1,234 cells", "10 s: 75.0 %", "1 min: –", "large enough", "p50", "p99",
        "localization", "4242", "5.0 MiB", "50.0,30.0", "1.0 s",
    ):  # fmt: skip
        assert piece in shown, piece


def test_a_daemon_that_does_not_beat_says_so() -> None:
    assert "PAUSED, no heartbeat" in text(snapshot(FULL, [], state="stopped"))
    assert "no client is connected" in text(snapshot(counters(), []))
    assert "HUNG" in text(snapshot(FULL, [], state="hung"))


@pytest.mark.parametrize("width", [80, 100, 120])
def test_nothing_is_cut_off_where_it_can_go_on_below(width: int) -> None:
    crowded = FULL | {
        "refused_over_budget": 123_456, "refused_quota": 654_321, "evictions": 10**6, "loads_failed": 99_999,
        "refused_over_budget_10min": 12, "zombies": 4096, "worker_crashes": 3, "misses": 10**9, "hits": 10**9,
    }  # fmt: skip
    named = replace(CLIENT, client="a_perception_node_with_a_very_long_name", pose=(-1234.5, -9876.5))
    shown = text(snapshot(crowded, [named]), width=width)
    assert max(map(len, shown.splitlines())) <= width
    for piece in (
        "free 25.0 MiB", "asked for since the start", "clients use 50.0 MiB of 100 MiB", "quota 654,321",
        "retired 4,096", "stale 0", "crashed 3", "-1234.5,-9876.5", "a_perception",
    ):  # fmt: skip
        assert piece in " ".join(shown.split()), piece


DRIVING = FULL | counters(
    prefetch_budget_bytes=50 * MIB, outage_tolerance_ns=10**10, last_outage_ns=2 * 10**9,
    prefetch_started=120, prefetch_used=100, prefetch_in_vain=3, prefetch_misses=7, prefetch_misses_1min=2,
    bytes_loaded=105, bytes_used=100, budget_bytes=100 * MIB,
)  # fmt: skip


@pytest.mark.parametrize("width", [60, 100])
def test_what_was_prefetched_and_what_of_it_was_used(width: int) -> None:
    found = snapshot(FULL | {name: value for name, value in DRIVING.items() if value}, [])
    shown = text(found, width=width)
    assert max(map(len, shown.splitlines())) <= width
    words = (
        "prefetch 120 fetched ahead 100 then asked for 3 in vain prefetch misses 7 (2 in 1 min)"
        " loaded 1.05 times what was used"
    )
    assert words in " ".join(shown.split())
    quiet = text(snapshot(FULL, []), width=width)
    assert "prefetch" not in quiet
    assert "origin" not in quiet
    away = text(snapshot(FULL | {"origin_out": 1, "last_outage_ns": 10**9 - 1}, []), width=width)
    assert "origin out of reach for less than a second" in " ".join(away.split())


def test_what_programs_learn_of_prefetching() -> None:
    assert msgspec.to_builtins(Prefetching.of(DRIVING)) == {
        "outage_tolerance_s": 10.0, "origin_out": False, "last_outage_s": 2.0, "prefetch_misses": 7,
        "prefetch_started": 120, "prefetch_used": 100, "prefetch_in_vain": 3, "prefetch_overtaken": 0,
        "bytes_prefetched": 0, "over_fetch": 1.05,
    }  # fmt: skip
    of_an_earlier_version = Prefetching.of({"hits": 3})
    assert (of_an_earlier_version.prefetch_misses, of_an_earlier_version.over_fetch) == (0, None)


def test_load_times_by_what_was_loaded() -> None:
    """Only of what there was."""
    found = snapshot(FULL, [])
    each = 1 + BUCKETS
    values = list(found._values.histograms)  # type: ignore[union-attr]
    names = [h.name for h in HISTOGRAMS]
    values[names.index("load_points") * each + 1 + 40] = 5
    values[names.index("load_cached") * each + 1 + 80] = 2
    found._values = found._values._replace(histograms=values)  # type: ignore[union-attr]
    lines = {line[:12].strip(): line for line in text(found).splitlines()}
    assert {"of points", "disk cache"} <= set(lines)
    assert "computed" not in lines
    assert lines["of points"].split()[-4:] == ["5", "since", "the", "start"]


LIVE = LiveMapRow(
    "lidar", "/live", 0.1, "map", 12, 1_234_567, 4 * MIB, 0, 3, 1, 0, 40, 9 * MIB, 100, 93, 16 * MIB
)
TROUBLED = replace(
    LIVE,
    name="radar",
    problem="chunk 1_-2_0 cannot be saved: No space left on device",
    damaged_count=2,
    waiting_bytes=MIB,
)


def test_status_has_a_line_for_each_live_map_and_its_verdict_the_problems() -> None:
    assert status_lines([], 0) == []
    assert status_lines([LIVE], 0) == [
        ("live lidar", "12 chunks, 4.0 MiB of 16.0 MiB, 1,234,567 voxels known, 4 not saved")
    ]
    assert status_lines([replace(LIVE, dirty=0, saving=0)], 0)[0][1].endswith(", all saved")
    found = snapshot(FULL, [])
    found.live = [TROUBLED]
    (_, memory), (_, ended) = status_lines([TROUBLED], 3)
    assert memory.startswith("12 chunks, 4.0 MiB of 16.0 MiB")
    assert ended.startswith("the process that keeps live maps ended 3 times")
    assert [(one.state, one.fact) for one in problems(found)] == [
        ("fail", f"live map radar: {TROUBLED.problem}"),
        ("warn", "live map radar: 2 lost chunks or damaged databases"),
    ]


@pytest.mark.parametrize("width", [40, 80, 120])
def test_live_maps_on_the_screen(width: int) -> None:
    found = snapshot(FULL, [CLIENT])
    assert "live" not in text(found).split()
    found.live = [LIVE, TROUBLED]
    shown = text(found, width=width)
    live = shown[shown.index("\nlive ") : shown.index("\nrequests")]
    assert max(map(len, live.splitlines())) <= width
    words = " ".join(live.split())
    for piece in (
        "live lidar: 12 chunks 8 clean 3 dirty 1 saving 4.0 MiB of 16.0 MiB 1,234,567 voxels known",
        "scans 100, on disk 93", "radar: 12 chunks", "waiting 1.0 MiB",
        "chunk 1_-2_0 cannot be saved: No space left on device",
        "lost chunks, damaged databases: 2;",
    ):  # fmt: skip
        assert piece in words, piece
    lines = screen(found, IDENTITY, width=width)
    styles = {piece.split()[-1]: style for line in lines for piece, style in line if piece.strip()}
    assert (styles["clean"], styles["dirty"], styles["saving"]) == ("green", "blue", "cyan")


def test_a_name_cannot_draw_on_the_screen() -> None:
    hostile = replace(CLIENT, client="\x1b[2J\x1b]0;owned\x07")
    for width in (80, 120):
        shown = text(snapshot(FULL, [hostile, CLIENT]), width=width)
        assert all(line.isprintable() for line in shown.splitlines())
        rows = [line for line in shown.splitlines() if "4242" in line]
        assert len({line.index("4242") for line in rows}) == 1, "columns stay aligned"


def cell(name: str, x: float, y: float, state: CellState) -> CellRow:
    return CellRow(name, "points", 1, "0" * 16, state, 4096, 10, (x, y, x + 20, y + 20), 3, 5, 7)


SCENE = Scene(
    bounds=(0.0, 0.0, 100.0, 60.0),
    disk=[(f"{x}_{y}.pcd", (x, y, x + 20.0, y + 20.0)) for x in range(0, 100, 20) for y in range(0, 60, 20)],
    rows=[cell("0_0.pcd", 0, 0, "resident"), cell("80_40.pcd", 80, 40, "zombie"),
          cell("80_0.pcd", 80, 0, "zombie"), cell("80_0.pcd", 80, 0, "resident")],
    clients=[CLIENT],
    now_ns=10 * 10**9,
    title="<city> & more",
    note="a note",
)  # fmt: skip


def test_the_terminal_picture_has_north_on_top() -> None:
    grid = terminal_rows(SCENE, 50, 30)
    assert (len(grid[0]), len(grid)) == (50, 15)  # characters are twice as high as wide
    assert grid[-1][0] == "resident"
    assert grid[0][-1] == "retired"
    assert grid[-1][-1] == "resident"  # of a cell's segments the one that can be handed out is shown
    assert grid[0][0] == "disk"
    assert grid[7][25] == "client"
    assert sum(row.count("window") for row in grid) > 20
    assert {state for row in grid for state in row} <= set(GLYPHS)


@pytest.mark.parametrize("size", [(1, 1), (7, 3), (200, 100)])
def test_any_terminal_will_do(size: tuple[int, int]) -> None:
    grid = terminal_rows(SCENE, *size)
    assert len(grid) <= size[1]
    assert all(len(row) == len(grid[0]) <= size[0] for row in grid)
    square = replace(CLIENT, window=Window("box", 1e6, 0.0, 5.0, 900.0), pose=(1e9, 0.0))
    empty = Scene((0.0, 0.0, 1.0, 1.0), [], [], [square], 0, "", "")
    assert terminal_rows(empty, *size)


def test_the_picture_is_xml_with_tooltips() -> None:
    root = ElementTree.fromstring(svg(SCENE))
    titles = [node.text or "" for node in root.iter("{http://www.w3.org/2000/svg}title")]
    assert titles[0] == "<city> & more"
    assert any("0_0.pcd" in title and "3 hits" in title for title in titles)
    assert any("80_0.pcd" in title and "retired" in title and "resident" in title for title in titles)
    assert any("localization, pid 4242" in title for title in titles)
    assert sum("on disk" in title for title in titles) == 15 - 3
    boxed = replace(CLIENT, window=Window("square", 50.0, 30.0, 25.0, 25.0), heading=None)
    assert 'rect class="window"' in svg(Scene(**{**vars(SCENE), "clients": [boxed]}))


def test_cells_fetched_ahead_are_marked_until_a_client_asks() -> None:
    ahead = replace(cell("0_0.pcd", 0, 0, "resident"), ahead=True)
    both = replace(cell("80_0.pcd", 80, 0, "resident"), ahead=True, layer="ndt(leaf=2.0)")
    rows = [ahead, both, cell("80_0.pcd", 80, 0, "resident"), cell("40_0.pcd", 40, 0, "stale")]
    scene = Scene(**{**vars(SCENE), "rows": rows, "clients": []})
    grid = terminal_rows(scene, 50, 30)
    assert grid[-1][0] == "ahead"
    assert grid[-1][-1] == "resident", "a layer of it was asked for"
    assert grid[-1][20] == "stale"
    picture = svg(scene)
    ElementTree.fromstring(picture)
    assert picture.count('class="cell ahead"') == 2, "it, and in the legend"
    assert "points: fetched ahead, 4.0 KiB" in picture
    assert "fetched ahead</text>" in picture


def test_names_of_clients_on_one_another_stand_side_by_side() -> None:
    beside = replace(CLIENT, client="perception")
    far = replace(CLIENT, client="planning", pose=(10.0, 30.0))
    root = ElementTree.fromstring(svg(Scene(**{**vars(SCENE), "clients": [CLIENT, beside, far]})))
    texts = root.iter("{http://www.w3.org/2000/svg}text")
    labels = [node.text for node in texts if node.get("class") == "label"]
    assert labels == ["localization, perception", "planning"]


def chunk(x: int, y: int, z: int, state: str) -> ChunkInfo:
    return ChunkInfo(ChunkKey(x, y, z), state, 7, 5, 2, 4096, 1, 1)


def test_chunks_of_a_live_map_from_above() -> None:
    """Of those above one another the one that has most to do is seen, the tooltip has all."""
    squares = chunk_squares(
        [
            chunk(0, 0, 1, "clean"), chunk(0, 0, -1, "dirty"), chunk(0, 0, 0, "saved"),
            chunk(-1, 0, 0, "saved"), chunk(1, 0, 0, "loading"), chunk(1, 0, 1, "clean"),
        ],
        0.5,
    )  # fmt: skip
    assert [(square.box, square.state) for square in squares] == [
        ((-32.0, 0.0, 0.0, 32.0), "saved"), ((0.0, 0.0, 32.0, 32.0), "dirty"),
        ((32.0, 0.0, 64.0, 32.0), "loading"),
    ]  # fmt: skip
    lines = squares[1].title.splitlines()
    assert [line.split(",")[0] for line in lines] == ["0_0_-1", "0_0_0", "0_0_1"]
    assert "z -32 to 0 m: not saved yet, 4.0 KiB, 7 voxels known" in lines[0]
    scene = Scene((-32.0, 0.0, 64.0, 32.0), [], [], [], 0, "live map lidar", "", chunks=squares)
    assert terminal_rows(scene, 6, 1) == [["saved", "saved", "dirty", "dirty", "loading", "loading"]]
    picture = svg(scene)
    ElementTree.fromstring(picture)
    assert [f'class="cell {state}"' in picture for state in ("saved", "dirty", "loading", "clean")] == [
        True, True, True, False,
    ]  # fmt: skip
    assert "not saved yet</text>" in picture


class Tags(HTMLParser):
    """Notes what a page refers to."""

    def __init__(self) -> None:
        super().__init__()
        self.references: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        del tag
        self.references += [value or "" for name, value in attrs if name in ("src", "href")]


def test_the_page_needs_nothing_else() -> None:
    page = html_page(SCENE)
    tags = Tags()
    tags.feed(page)
    assert tags.references == []
    assert "&lt;city&gt; &amp; more" in page
    assert "<td>localization</td><td>4242</td>" in page
    assert "No client is connected" in html_page(Scene(**{**vars(SCENE), "clients": []}))
