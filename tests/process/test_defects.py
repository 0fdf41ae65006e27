# SPDX-License-Identifier: Apache-2.0
"""Exceptions that nobody expected: the daemon goes on; if one comes again and again, its next life does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import Deadline
from tests.support.divided_map import DividedMap
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]


def test_the_daemon_goes_on(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, tmp_path: Path
) -> None:
    """A defect outside of any request, in freeing memory: told with its traceback, counted, and survived."""
    from_now_on = tmp_path / "defect"
    one = daemon(divided_map.root, environment={"SHMMAP_TEST_DEFECT": f"daemon.unlink:3:{from_now_on}"})
    client = connect(one)
    loaded = client.area(circle(0, 0, 30)).cells
    client.ask("release", None)
    from_now_on.touch()
    client.ask("evict", None)
    waiting = Deadline()
    while waiting(client.ask("stats")[4]["zombies"] > 0):
        pass
    assert len(client.area(circle(0, 0, 30)).cells) == len(loaded)
    assert client.ask("stats")[4]["defects"] == 3
    assert one.log.count(" ERROR   defect place=") == 1, "once in a while, not each time"
    assert "RuntimeError: a defect at daemon.unlink" in one.log
    shmmap = Shmmap(one, tmp_path)
    assert shmmap("health").rstrip().endswith("; it survived 3 exceptions, see its log")
    assert shmmap.json("health")["defects"] == 3
    assert "it survived 3 exceptions" in shmmap("doctor")


def test_again_and_again_is_too_much(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, tmp_path: Path
) -> None:
    from_now_on = tmp_path / "defect"
    one = daemon(divided_map.root, environment={"SHMMAP_TEST_DEFECT": f"daemon.unlink:1000:{from_now_on}"})
    client = connect(one)
    loaded = client.area(circle(0, 0, 30)).cells
    client.ask("release", None)
    from_now_on.touch()
    client.send("evict", [loaded[0].id])
    assert one.process is not None
    assert one.process.wait(60) not in (0, -9)
    one.killed = True
    one.environment.pop("SHMMAP_TEST_DEFECT")
    one.start()
    again = connect(one)
    assert again.ask("stats")[4]["adopted"] >= len(loaded) - 1, "what is in memory is kept"
