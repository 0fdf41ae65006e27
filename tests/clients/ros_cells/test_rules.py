# SPDX-License-Identifier: Apache-2.0
"""What nodes for ROS 2 decide without a daemon: names, areas, the cells of recent answers, sizes."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shmmap_clients.ros_cells import Answer, RecentCells, cell_name, cloud_layout, split_name
from shmmap_clients.ros_cells.answers import sensible, touches
from shmmap_clients.ros_cells.point_cloud import message_bytes

# --- names --------------------------------------------------------------------------------------------


@given(st.text() | st.from_regex(r"(/[ab@.]*)?@[0-9a-f]{16}", fullmatch=True), st.integers(0, 2**64 - 1))
def test_a_name_is_split_into_what_it_was_made_of(cell_id: str, version: int) -> None:
    assert split_name(cell_name(cell_id, version)) == (cell_id, version)


def test_names() -> None:
    assert cell_name("/a/0_0.pcd", 255) == "/a/0_0.pcd@00000000000000ff"
    for plain in (
        "",
        "@",
        "a",
        "a@b",
        "a@00000000000000fF",
        "a@0ff",
        "a@000000000000000ff",
        "a@00000000000000ff ",
    ):
        assert split_name(plain) == (plain, None)
    assert split_name("a@00000000000000ff\n") == ("a@00000000000000ff\n", None)
    assert split_name("a\nb@@00000000000000ff") == ("a\nb@", 255)


# --- areas --------------------------------------------------------------------------------------------


F32 = st.floats(width=32) | st.sampled_from([math.inf, -math.inf, math.nan, 0.0])
SMALL = st.floats(-50, 50, width=32)


def autoware_touches(x: float, y: float, radius: float, box: tuple[float, ...]) -> bool:
    """``cylinder_and_box_overlap_exists`` of autoware_map_loader's utils.cpp, both clauses."""
    low_x, low_y, high_x, high_y = (float(np.float32(one)) for one in box)
    if low_x - radius <= x <= high_x + radius and low_y - radius <= y <= high_y + radius:
        return True
    return any(math.hypot(x - a, y - b) <= radius for a in (low_x, high_x) for b in (low_y, high_y))


@given(F32 | SMALL, F32 | SMALL, F32 | SMALL, st.lists(st.tuples(SMALL, SMALL), max_size=4))
def test_areas_touch_what_autoware_s_touch(
    x: float, y: float, radius: float, corners: list[tuple[float, float]]
) -> None:
    area = SimpleNamespace(center_x=x, center_y=y, radius=radius)
    boxes = np.array([(a, b, a + 20.0, b + 20.0) for a, b in corners], float).reshape(-1, 4)
    found = touches(area, boxes)
    assert found.tolist() == [autoware_touches(x, y, radius, tuple(box)) for box in boxes.tolist()]
    square = sensible(area)
    assert (square is not None) == (all(map(math.isfinite, (x, y, radius))) and radius >= 0)
    if square is not None:
        assert square.overlaps(boxes).tolist() == found.tolist()


# --- recent cells -------------------------------------------------------------------------------------


def cell(name: str, version: int, nbytes: int = 1) -> Any:
    return SimpleNamespace(id=name, version=version, nbytes=nbytes)


def test_cells_are_kept_for_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr("shmmap_clients.ros_cells.catalogue.time.monotonic", lambda: now_s[0])
    recent = RecentCells()
    first, second = cell("a", 1), cell("b", 1)
    assert recent.kept([first, second]) == [first, second]
    again = recent.kept([cell("a", 1), cell("a", 2), cell("a", 1)])
    assert again[0] is again[2] is first, "as it was kept"
    assert again[1].version == 2
    now_s[0] += 1.9
    assert not recent.release_idle()
    recent.kept([second])
    now_s[0] += 1.9
    assert (recent.release_idle(), len(recent)) == (False, 3), "a client has asked"
    now_s[0] += 0.2
    assert (recent.release_idle(), len(recent), recent.release_idle()) == (True, 0, False)
    assert recent.kept([cell("a", 1)])[0] is not first


def test_few_bytes_are_kept_and_the_newest() -> None:
    recent = RecentCells()
    large = [cell("abc"[n], 1, 30 << 20) for n in range(3)]
    assert recent.kept(large) == large, "an answer has all of them"
    assert len(recent) == 2
    assert recent.kept([cell("c", 1), cell("b", 1)]) == [large[2], large[1]]
    huge = cell("h", 1, 100 << 20)
    assert recent.kept([huge]) == [huge]
    assert len(recent) == 0


# --- answers ------------------------------------------------------------------------------------------


def test_what_is_wrong_with_an_answer() -> None:
    assert Answer().problem == ""
    found = Answer(left_out=[f"{n}: gone" for n in range(5)], too_large=1200)
    assert found.problem == (
        "1,200 cells do not fit into one answer, and 0 are sent: ask for fewer at once;"
        " left out of an answer: 0: gone; 1: gone; 2: gone; and 2 more"
    )


@given(
    st.text(max_size=40), st.dictionaries(st.text(max_size=20), st.sampled_from("fBHdQ")), st.integers(0, 9)
)
def test_a_cell_takes_no_more_than_is_reckoned(name: str, kinds: dict[str, str], rows: int) -> None:
    """All texts have a length and an end, and every part may be aligned to eight bytes."""
    columns: dict[str, Any] = {"xyz": np.zeros((rows, 3), "<f4")}
    columns |= {one: np.zeros(rows, kind) for one, kind in kinds.items() if one != "xyz"}
    layout = cloud_layout(columns)
    texts = [name, "", *(field[0] for field in layout.fields)]
    takes = sum(len(one.encode()) + 5 + 7 for one in texts) + layout.point_step * rows
    takes += len(layout.fields) * 9 + 4 * 12 + 2 + 4 * 4
    assert takes <= message_bytes(columns, name)
