# SPDX-License-Identifier: Apache-2.0
"""The statistics segment as the reader in C++ sees it: what the one in Python says of the same segment."""

from __future__ import annotations

import os
import signal
import struct
from pathlib import Path

import pytest

import shmmap
from shmmap.statistics.counters import COUNTERS
from shmmap.statistics.reader import read_statistics
from tests.cpp.conftest import DaemonFactory
from tests.support.cpp_client import CppProgram
from tests.support.daemon_process import Deadline
from tests.support.divided_map import DividedMap

LAYERS = ("points", "ndt(leaf=2.0)")


def rows(answer: list[list[str]], kind: str) -> list[list[str]]:
    """The words of the lines of a kind."""
    return [line[1:] for line in answer if line[0] == kind]


def test_everything_in_it(daemon: DaemonFactory, program: CppProgram, divided_map: DividedMap) -> None:
    """Of a daemon that was stopped: nothing changes between the two readers."""
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint, name="python") as client:
        client.area(shmmap.Circle(0, 0, 30), LAYERS, wait=60.0)
        waiting = Deadline()
        while waiting(not read_statistics(one.instance, one.shm_dir).counters["handles_sent"]):
            pass
        one.send(signal.SIGSTOP)
        os.waitid(os.P_PID, one.pid, os.WSTOPPED)
        answer = program.call("statistics", one.instance, one.shm_dir)
        python = read_statistics(one.instance, one.shm_dir)
        one.send(signal.SIGCONT)
    assert rows(answer, "state") == [["stopped"]] == [[python.state]]
    assert python.identity is not None
    identity = dict(rows(answer, "identity"))
    assert (identity["instance"], identity["pid"]) == (one.instance, str(one.pid))
    assert identity["map_path"] == python.identity.map_path
    assert rows(answer, "counter") == [
        [d.name, d.unit, d.kind, d.help, str(python.counters[d.name])] for d in python.descriptions
    ]
    assert len(python.descriptions) == len(COUNTERS)
    for name, total, p99, counts in rows(answer, "histogram"):
        histogram = python.histograms[name]
        assert int(total) == histogram.sum_ns
        assert tuple(map(int, counts.split())) == histogram.counts
        assert float(p99) == pytest.approx(histogram.quantile_s(0.99) or float("nan"), rel=1e-12, nan_ok=True)
    assert len(rows(answer, "histogram")) == len(python.histograms) > 0


def test_how_the_daemon_is(daemon: DaemonFactory, program: CppProgram, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)

    def state() -> str:
        ((found,),) = rows(program.call("statistics", one.instance, one.shm_dir), "state")
        return found

    assert state() == "healthy"
    one.kill()
    assert state() == "dead"
    one.start()
    assert state() == "healthy"
    one.stop()
    assert state() == "absent"


def test_a_segment_of_which_any_byte_was_changed(
    daemon: DaemonFactory, program: CppProgram, divided_map: DividedMap, tmp_path: Path
) -> None:
    """Its header is refused, whichever of its bytes is wrong."""
    one = daemon(divided_map.root)
    whole = Path(one.shm_dir, f"shmmap.{one.instance}.statistics").read_bytes()
    place = tmp_path / "shmmap.other.statistics"
    refused = 0
    for at in range(64):
        changed = bytearray(whole)
        changed[at] ^= 1 + at
        place.write_bytes(changed)
        answer = program.ask("statistics", "other", tmp_path)
        if answer[0][0] == "error":
            refused += answer[0][1] == "segment_corrupt"
    assert refused == 64


def test_tables_of_more_bytes_than_can_be_counted(
    daemon: DaemonFactory, program: CppProgram, divided_map: DividedMap, tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    whole = bytearray(Path(one.shm_dir, f"shmmap.{one.instance}.statistics").read_bytes())
    # together they are 2^64 and 65536: in 64 bits as few as there are
    for count, histograms, row in ((2**31, 2**31 + 65536, 2**32 - 65535), (2**32 - 1, 2**32 - 1, 0)):
        whole[20:28] = struct.pack("<II", count, row)
        whole[64:68] = struct.pack("<I", histograms)
        (tmp_path / "shmmap.other.statistics").write_bytes(whole)
        ((kind, code, _),) = program.ask("statistics", "other", tmp_path)
        assert (kind, code) == ("error", "segment_corrupt")


def test_a_segment_that_ends_too_early(
    daemon: DaemonFactory, program: CppProgram, divided_map: DividedMap, tmp_path: Path
) -> None:
    one = daemon(divided_map.root)
    whole = Path(one.shm_dir, f"shmmap.{one.instance}.statistics").read_bytes()
    place = tmp_path / "shmmap.other.statistics"
    refused = []
    for size in (0, 1, 63, 64, 4096, 16384, *range(20_000, len(whole), 4001)):
        place.write_bytes(whole[:size])
        answer = program.ask("statistics", "other", tmp_path)
        if answer[0][0] == "error":
            assert answer[0][1] == "segment_corrupt"
            refused.append(size)
    assert refused[:6] == [0, 1, 63, 64, 4096, 16384]
    os.unlink(place)
    assert program.ask("statistics", "other", tmp_path) == [["state", "absent"]]
