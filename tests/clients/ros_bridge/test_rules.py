# SPDX-License-Identifier: Apache-2.0
"""What the bridge decides without DDS: areas, versions of clients, names, parameters, turns."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("cyclonedds", reason="needs the package cyclonedds")

from shmmap_clients.ros_bridge import participant
from shmmap_clients.ros_bridge.map_answers import RecentCells, Requesters, sensible, touches
from shmmap_clients.ros_bridge.parameters import Parameters
from shmmap_clients.ros_bridge.participant import settings
from shmmap_clients.ros_bridge.service_server import Request, Requester
from shmmap_clients.ros_bridge.worker import MAX_PER_CLIENT, MAX_WAITING, WaitingRequests

import shmmap

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


# --- versions -----------------------------------------------------------------------------------------


def test_what_a_client_was_sent_is_what_it_holds() -> None:
    requesters = Requesters(most=2)
    now = {"a": 1, "b": 2, "c": 3}
    held = requesters.held("one", ["a", "x", "a"], now)
    assert held == [("a", 1), ("x", None)], "ours to know are current, once"
    requesters.answered("one", held, ["x"], {"b": 2})
    now = {"a": 10, "b": 20}
    assert requesters.held("one", ["b", "a"], now) == [("b", 2), ("a", 1)]
    assert requesters.held("two", ["b"], now) == [("b", 20)], "another client's"
    requesters.answered("one", requesters.held("one", ["b"], now), ["b"], {"a": 10})
    assert requesters.held("one", ["a", "b"], now) == [("a", 10), ("b", 20)]


def test_the_one_that_has_not_asked_for_longest_is_forgotten() -> None:
    requesters = Requesters(most=2)
    for client in ("one", "two", "one", "three"):
        requesters.answered(client, [], [], {"a": 1})
    assert len(requesters) == 2
    assert [requesters.held(client, ["a"], {"a": 5})[0][1] for client in ("one", "two", "three")] == [
        1,
        5,
        1,
    ]
    requesters.keep_only({"three", "four"})
    assert len(requesters) == 1
    assert requesters.held("three", ["a"], {}) == [("a", 1)]


# --- turns --------------------------------------------------------------------------------------------


def request(client: str, number: int = 0) -> Request:
    server: Any = None
    return Request(server, number, Requester(client, incompatible=False, vendor=""), 0)


def test_a_client_has_few_requests_waiting_and_its_newest_count() -> None:
    waiting = WaitingRequests()
    for number in range(MAX_PER_CLIENT + 3):
        assert waiting.put(request("flood", number))
        if number == 1:
            assert waiting.put(request("other"))
    taken = [waiting.get() for _ in range(len(waiting))]
    assert [(one.requester.name, one.message) for one in taken] == [
        ("other", 0),
        *(("flood", number) for number in range(3, MAX_PER_CLIENT + 3)),
    ]
    assert not waiting
    for number in range(MAX_WAITING):
        assert waiting.put(request(f"{number}"))
    assert not waiting.put(request("one too many"))


def test_clients_take_turns() -> None:
    """However many one has waiting, and what could not be answered yet comes after all others."""
    waiting = WaitingRequests()
    for number in range(MAX_PER_CLIENT):
        waiting.put(request("greedy", number))
    waiting.put(request("other"))
    slow = waiting.get()
    waiting.requeue(slow)
    waiting.put(request("new"))
    taken = [waiting.get() for _ in range(len(waiting))]
    assert [one.requester.name for one in taken[:3]] == ["other", "new", "greedy"]
    assert {one.requester.name for one in taken[3:]} == {"greedy"}
    assert sorted(one.message for one in taken if one.requester.name == "greedy") == [0, 1, 2, 3]


# --- names --------------------------------------------------------------------------------------------


def test_names_in_full() -> None:
    assert participant.resolved("a/b_1", "/map") == "/map/a/b_1"
    assert participant.resolved("/a", "/map") == "/a"
    assert participant.resolved("a", "/") == "/a"
    assert (participant.request_topic("/a"), participant.reply_topic("/a"), participant.topic("/a")) == (
        "rq/aRequest",
        "rr/aReply",
        "rt/a",
    )


@pytest.mark.parametrize(
    "name", ["", "/", "a/", "a//b", "1a", "a/1b", "a b", "a.b", "/map/~", "é", "a" * 300]
)
def test_names_that_are_none(name: str) -> None:
    with pytest.raises(shmmap.BadRequest):
        participant.resolved(name, "/map")
    with pytest.raises(shmmap.BadRequest):
        participant.resolved("a", name if name != "/" else "//")


def test_a_node_s_name_has_no_slash() -> None:
    assert participant.node_name("loader") == "loader"
    with pytest.raises(shmmap.BadRequest):
        participant.node_name("/loader")


def test_settings_are_the_user_s_and_those_of_ros() -> None:
    assert settings({}) == ""
    assert settings({"CYCLONEDDS_URI": "file:///x.xml"}) == "file:///x.xml"
    both = settings({"CYCLONEDDS_URI": "file:///x.xml", "ROS_LOCALHOST_ONLY": "1"})
    assert both.endswith(",file:///x.xml"), "so that it counts over the other"
    assert "127.0.0.1" in both
    assert "127.0.0.1" not in settings({"ROS_LOCALHOST_ONLY": "0"})


# --- parameters ---------------------------------------------------------------------------------------


def listed(prefixes: list[str], depth: int) -> tuple[list[str], list[str]]:
    parameters = Parameters({"b": True, "a.x": 1.5, "a.y.z": "t", "ab": ["u", "v"]})
    found = parameters.reply("list_parameters", SimpleNamespace(prefixes=prefixes, depth=depth))["result"]
    return found.names, found.prefixes


def test_parameters_are_listed_as_rclcpp_does() -> None:
    """Its `NodeParameters::list_parameters`."""
    assert listed([], 0) == (["a.x", "a.y.z", "ab", "b"], ["a", "a.y"])
    assert listed([], 1) == (["ab", "b"], [])
    assert listed([], 2) == (["a.x", "ab", "b"], ["a"])
    assert listed(["a"], 0) == (["a.x", "a.y.z"], ["a", "a.y"])
    assert listed(["a"], 1) == (["a.x"], ["a"])
    assert listed(["a.y", "b"], 1) == (["a.y.z", "b"], ["a.y"])
    assert listed(["c"], 0) == ([], [])


def test_values_have_their_types() -> None:
    parameters = Parameters({"b": True, "d": 1.5, "s": "t", "l": ["u", "v"]})
    asked = SimpleNamespace(names=["l", "b", "d", "s"])
    values = parameters.reply("get_parameters", asked)["values"]
    assert (
        [one.type for one in values]
        == [9, 1, 3, 4]
        == parameters.reply("get_parameter_types", asked)["types"]
    )
    assert (values[0].string_array_value, values[1].bool_value) == (["u", "v"], True)
    assert (values[2].double_value, values[3].string_value) == (1.5, "t")
    assert parameters.reply("describe_parameters", SimpleNamespace(names=["b", "?"])) == {"descriptors": []}
    result = parameters.reply(
        "set_parameters_atomically", SimpleNamespace(parameters=[SimpleNamespace(name="?")])
    )
    assert "not declared" in result["result"].reason
    assert parameters.reply("set_parameters_atomically", SimpleNamespace(parameters=[]))["result"].successful


# --- recent cells -------------------------------------------------------------------------------------


def cell(name: str, version: int, nbytes: int = 1) -> Any:
    return SimpleNamespace(id=name, version=version, nbytes=nbytes)


def test_cells_are_kept_for_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [100.0]
    monkeypatch.setattr("shmmap_clients.ros_bridge.map_answers.time.monotonic", lambda: now_s[0])
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
