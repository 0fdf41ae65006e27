# SPDX-License-Identifier: Apache-2.0
"""What the service manager is told, in which order, and how often."""

from __future__ import annotations

import math
import os
import socket
from pathlib import Path

import pytest

from shmmap.daemon.service_manager.status import (
    STATUS_EVERY_S,
    ServiceManager,
    notify,
    status_line,
    watchdog_interval_s,
)


class Heard(list[tuple[str, ...]]):
    """Everything that was told."""

    def tell(self, *lines: str) -> None:
        self.append(lines)


def manager(environ: dict[str, str] | None = None) -> tuple[ServiceManager, Heard]:
    heard = Heard()
    return ServiceManager(environ or {}, heard.tell), heard


@pytest.mark.parametrize(
    ("environ", "seconds"),
    [
        ({}, math.inf),
        ({"WATCHDOG_USEC": ""}, math.inf),
        ({"WATCHDOG_USEC": "0"}, math.inf),
        ({"WATCHDOG_USEC": "-3"}, math.inf),
        ({"WATCHDOG_USEC": "soon"}, math.inf),
        ({"WATCHDOG_USEC": "3000000"}, 1.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": ""}, 1.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}, 1.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"}, math.inf),
    ],
)
def test_how_often_the_watchdog_is_fed(environ: dict[str, str], seconds: float) -> None:
    assert watchdog_interval_s(environ) == seconds


def test_the_watchdog_is_fed_at_beats_alone() -> None:
    one, heard = manager({"WATCHDOG_USEC": "3000000"})
    for tenths in range(31):
        one.beat(100 + tenths / 10, lambda: "")
    assert heard == [("WATCHDOG=1",)] * 4  # at 0, 1, 2 and 3 s


def test_a_status_is_told_when_it_changes_and_not_at_each_beat() -> None:
    one, heard = manager()
    lines = iter(["a", "a", "b", "c"])
    for tenths in range(int(4 * STATUS_EVERY_S * 10)):
        one.beat(tenths / 10, lambda: next(lines))
    assert heard == [("STATUS=a",), ("STATUS=b",), ("STATUS=c",)]


def test_a_reload_is_over_when_the_last_one_is() -> None:
    one, heard = manager()
    one.reloading()
    one.beat(0, lambda: "not now")
    one.reloading()
    one.reloaded("first")
    one.reloaded("second")
    assert [lines[0] for lines in heard] == ["RELOADING=1", "RELOADING=1", "READY=1"]
    assert heard[0][1].removeprefix("MONOTONIC_USEC=").isdigit()
    one.beat(10, lambda: "afterwards")
    assert heard[-2:] == [("READY=1", "STATUS=second"), ("STATUS=afterwards",)]


def test_start_stop_and_failure() -> None:
    one, heard = manager()
    one.ready("serving")
    one.stopping("freeing memory")
    one.failed("no map")
    assert heard == [
        ("READY=1", "STATUS=serving", f"MAINPID={os.getpid()}"),
        ("STOPPING=1", "STATUS=freeing memory"),
        ("STATUS=no map",),
    ]


def test_the_line_an_operator_reads() -> None:
    line = status_line(
        resident=212, cells=4096, used_bytes=3 << 30, budget_bytes=6 << 30, clients=5, failed=0
    )
    assert line == "212 of 4096 cells, 3.0 of 6.0 GiB, 5 clients"
    line = status_line(resident=0, cells=1, used_bytes=0, budget_bytes=64 << 20, clients=1, failed=2)
    assert line == "0 of 1 cells, 0.0 of 64.0 MiB, 1 client, 2 failed loads"


@pytest.mark.parametrize("abstract", [False, True])
def test_notify(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool) -> None:
    name = f"{tmp_path}/notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name if abstract else name)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + name if abstract else name)
        notify("READY=1", "STATUS=serving 5 cells of a\nMAINPID=1")
        manager.settimeout(10)
        assert manager.recv(100) == b"READY=1\nSTATUS=serving 5 cells of a MAINPID=1"


@pytest.mark.parametrize(
    "address", ["", "/nowhere/notify", "@nobody-listens-here", "relative", "@" + "x" * 300]
)
def test_nobody_listens(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    notify("READY=1")
    monkeypatch.delenv("NOTIFY_SOCKET")
    notify("READY=1")
