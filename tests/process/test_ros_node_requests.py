# SPDX-License-Identifier: Apache-2.0
"""Requests of ROS 2 nodes that wait for cells or for the daemon, against real daemons and without ROS."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any

import pytest
from shmmap_clients.ros_cells import Answer, Catalogue, CellAnswers, RecentCells, follow_events
from shmmap_clients.ros_node import requests as requests_module
from shmmap_clients.ros_node.requests import Requests

import shmmap
from shmmap.errors import Busy
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, until
from tests.support.divided_map import DividedMap

LONG_S = 60.0


class Serving:
    """The node without ROS: its requests, and what it logs."""

    def __init__(self, one: DaemonProcess, wait_s: float) -> None:
        self.log: list[str] = []
        self.clients: list[shmmap.Client] = []
        self._endpoint = one.endpoint
        self.answers = CellAnswers(Catalogue(), RecentCells())
        self.requests = Requests(self._connect, wait_s, self.log.append, self.log.append)
        self.stop = threading.Event()
        self.events = threading.Thread(
            target=follow_events, args=(one.endpoint, self.stop, self.requests.ask_again)
        )
        self.events.start()

    def _connect(self) -> shmmap.Client:
        self.clients.append(shmmap.connect(self._endpoint))
        return self.clients[-1]

    def ask(self, x: float, y: float, radius: float = 1.0) -> SimpleQueue[Any]:
        """Ask for an area; returns where the answer arrives."""
        place = SimpleNamespace(center_x=x, center_y=y, radius=radius)
        return self.run(lambda client, last: self.answers.partial(client, place, last))

    def run(self, work: Callable[[shmmap.Client, bool], object]) -> SimpleQueue[Any]:
        arrives: SimpleQueue[Any] = SimpleQueue()
        self.requests.ask(work, arrives.put)
        return arrives

    def asking_now_and_then(self, arrives: SimpleQueue[Any]) -> Any:
        """Ask again as the node does each second, until an answer is there."""

        def has_arrived() -> bool:
            self.requests.ask_again()
            return not arrives.empty()

        until(has_arrived)
        return arrives.get()

    def close(self) -> None:
        self.stop.set()
        self.events.join()
        for client in self.clients:
            client.close()


@pytest.fixture
def serving() -> Iterator[Callable[..., Serving]]:
    made: list[Serving] = []

    def make(one: DaemonProcess, wait_s: float = LONG_S) -> Serving:
        made.append(Serving(one, wait_s))
        return made[-1]

    yield make
    for one in made:
        one.close()


def corner(divided_map: DividedMap, at: int) -> tuple[float, float]:
    """Middle of a cell."""
    x, y = sorted(divided_map.corners.values())[at]
    return x + 10.0, y + 10.0


def test_no_request_waits_for_another(
    daemon: DaemonFactory, divided_map: DividedMap, serving: Callable[..., Serving]
) -> None:
    one = daemon(divided_map.root)
    node = serving(one)
    warm = corner(divided_map, 0)
    assert len(node.ask(*warm).get(timeout=LONG_S).cells) == 1
    stopped = one.stop_loaders()
    cold = [node.ask(*corner(divided_map, at)) for at in range(1, 21)]
    assert len(node.ask(*warm).get(timeout=LONG_S).cells) == 1
    assert all(one.empty() for one in cold)
    assert len(node.requests.waiting) == 20
    for pid in stopped:
        os.kill(pid, signal.SIGCONT)
    for at, arrives in enumerate(cold, 1):
        (cell,) = node.asking_now_and_then(arrives).cells
        assert cell.box[:2] == sorted(divided_map.corners.values())[at]
    assert len(node.requests.waiting) == 0
    assert node.log == []


def test_what_is_there_goes_when_the_time_is_over(
    daemon: DaemonFactory, divided_map: DividedMap, serving: Callable[..., Serving]
) -> None:
    one = daemon(divided_map.root)
    node = serving(one, wait_s=0.3)
    near = corner(divided_map, 0)
    until(lambda: len(node.asking_now_and_then(node.ask(*near)).cells) == 1)
    stopped = one.stop_loaders()
    answer: Answer = node.asking_now_and_then(node.ask(*near, 12.0))
    assert len(answer.cells) == 1
    assert len(answer.left_out) == 3
    for pid in stopped:
        os.kill(pid, signal.SIGCONT)


def test_requests_wait_while_the_daemon_is_away(
    daemon: DaemonFactory, divided_map: DividedMap, serving: Callable[..., Serving]
) -> None:
    one = daemon(divided_map.root)
    node = serving(one, wait_s=0.0)  # the time of cells does not run meanwhile
    places = [corner(divided_map, at) for at in range(6)]
    until(lambda: len(node.asking_now_and_then(node.ask(*places[0])).cells) == 1)
    one.kill()
    asked = [node.ask(*place) for place in places]
    until(lambda: node.requests.reachable is False)
    assert len(node.requests.waiting) == len(asked)
    one.start()
    for arrives in asked:
        assert isinstance(node.asking_now_and_then(arrives), Answer)
    assert len(node.log) == 2
    assert node.log[0].startswith("requests wait until the daemon answers: ")
    assert node.log[1] == "the daemon answers again"


def test_a_request_before_the_daemon_is_there(
    daemon: DaemonFactory, divided_map: DividedMap, serving: Callable[..., Serving]
) -> None:
    one = daemon(divided_map.root, start=False)
    node = serving(one)
    arrives = node.ask(*corner(divided_map, 3))
    until(lambda: node.requests.reachable is False)
    one.start()
    assert len(node.asking_now_and_then(arrives).cells) == 1
    assert len(node.log) == 2


def test_one_that_cannot_be_answered_gets_its_error(
    daemon: DaemonFactory, divided_map: DividedMap, serving: Callable[..., Serving]
) -> None:
    node = serving(daemon(divided_map.root))

    def fail(_client: shmmap.Client, _last: bool) -> None:
        raise ValueError("no such thing")

    for _ in range(8):  # more than threads
        assert str(node.run(fail).get(timeout=LONG_S)) == "no such thing"
    assert len(node.ask(*corner(divided_map, 0)).get(timeout=LONG_S).cells) == 1


def test_above_a_limit_the_oldest_is_given_up(
    daemon: DaemonFactory,
    divided_map: DividedMap,
    serving: Callable[..., Serving],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(requests_module, "MAX_WAITING", 3)
    one = daemon(divided_map.root)
    node = serving(one)
    node.ask(*corner(divided_map, 0)).get(timeout=LONG_S)
    stopped = one.stop_loaders()
    asked = [node.ask(*corner(divided_map, at)) for at in range(1, 5)]
    assert isinstance(asked[0].get(timeout=LONG_S), Busy)
    assert len(node.requests.waiting) == 3
    for pid in stopped:
        os.kill(pid, signal.SIGCONT)
    for arrives in asked[1:]:
        assert len(node.asking_now_and_then(arrives).cells) == 1
