# SPDX-License-Identifier: Apache-2.0
"""What the bridge decides without DDS: names, parameters, turns, settings."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

pytest.importorskip("cyclonedds", reason="needs the package cyclonedds")

from shmmap_clients.ros_bridge import participant
from shmmap_clients.ros_bridge.parameters import Parameters
from shmmap_clients.ros_bridge.participant import settings
from shmmap_clients.ros_bridge.service_server import Request, Requester
from shmmap_clients.ros_bridge.worker import MAX_PER_CLIENT, MAX_WAITING, WaitingRequests

import shmmap

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
        ("flood", 3),
        ("other", 0),
        *(("flood", number) for number in range(4, MAX_PER_CLIENT + 3)),
    ]
    assert not waiting
    for number in range(MAX_WAITING):
        assert waiting.put(request(f"{number}"))
    assert not waiting.put(request("one too many"))


def test_clients_take_turns() -> None:
    """However many one has waiting; what could not be answered yet comes before its client's others."""
    waiting = WaitingRequests()
    for number in range(MAX_PER_CLIENT):
        waiting.put(request("greedy", number))
    waiting.put(request("other"))
    slow = waiting.get()
    waiting.put(request("new"))
    waiting.put_back(slow)
    taken = [waiting.get() for _ in range(len(waiting))]
    assert [one.requester.name for one in taken] == ["other", "greedy", "new", "greedy", "greedy", "greedy"]
    assert [one.message for one in taken if one.requester.name == "greedy"] == [0, 1, 2, 3]
    for number in range(1, MAX_PER_CLIENT + 1):
        waiting.put(request("greedy", number))
    waiting.put_back(slow)
    assert [waiting.get().message for _ in range(len(waiting))] == [1, 2, 3, 4], "the newest count"


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
    near = settings({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "10.0.0.1;a<b"})
    assert "<AllowMulticast>false<" in near
    assert "127.0.0.1" in near
    assert "autodetermine" in near, "for the other peers"
    assert "autodetermine" not in settings({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})
    assert re.findall(r"Peer address=\S+?/>", near) == [
        'Peer address="localhost"/>',
        'Peer address="10.0.0.1"/>',
        'Peer address="a&lt;b"/>',
    ]
    peers = settings({"ROS_STATIC_PEERS": "10.0.0.1"})
    assert "localhost" not in peers
    assert "AllowMulticast" not in peers
    assert '<Peer address="10.0.0.1"/>' in peers
    assert settings({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}) == ""
    off, default = (
        settings({"ROS_AUTOMATIC_DISCOVERY_RANGE": one, "ROS_STATIC_PEERS": "10.0.0.1"})
        for one in ("OFF", "SYSTEM_DEFAULT")
    )
    assert "<Tag>ros_discovery_off_" in off
    assert "10.0.0.1" not in off
    assert default == ""
    for one in (near, peers, off):
        ElementTree.fromstring(one)
    with pytest.raises(shmmap.errors.ConfigError, match=r"'NEAR' is none of SUBNET, LOCALHOST"):
        settings({"ROS_AUTOMATIC_DISCOVERY_RANGE": "NEAR"})


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
