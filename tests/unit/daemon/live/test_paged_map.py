# SPDX-License-Identifier: Apache-2.0
"""A live map with little memory equals an unbounded one, and nothing of it is lost when its writer is killed.

Rolling-Bonxai fails here.  At 8936187 it updated the chunks around the sensor's and not that one, put the
scan of a crossing one chunk off, dropped scans while a chunk was loaded, and left 29 changed chunks unwritten
at its end.  At 1a489e7 it dropped the rays that end in a chunk that is not there (3 % of a drive's points),
and read a chunk from its file before that was written (90 % of its voxels were lost).
"""

from __future__ import annotations

import errno
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from shmmap.chunks.layout import OUT_OF_SERVICE
from shmmap.daemon.live.chunk_memory import ChunkMemory
from tests.support.chunk_memory import ChunkMemory as Unbounded
from tests.support.forked_programs import run_verb
from tests.support.live_drive import RESOLUTION, SCANS, Voxel, marked, opened, voxels_on_disk
from tests.support.odd_files import failing

LITTLE = "1500000", "0.05"
"""Of about eight megabytes that the whole map takes, and more than one chunk can; saved all the time."""


@pytest.fixture(scope="module")
def reference() -> dict[Voxel, int]:
    """The voxels of a map that has memory for everything."""
    unbounded = Unbounded(RESOLUTION)
    for number, marks in enumerate(marked(), 1):
        unbounded.apply(marks, scan=number)
    return unbounded.voxels()


def run(shm: Path, disk: Path, first: int, crash: str = "", code: int = 0) -> str:
    """Drive from a scan to the end, or until it is killed; what it says."""
    words = [str(shm), str(disk), *LITTLE, str(first)]
    environment = {**os.environ, **({"SHMMAP_TEST_CRASH": crash} if crash else {})}
    done = run_verb(words, environment, module="tests.support.live_drive")
    assert done.returncode == code, done.stderr
    return done.stdout


def said(lines: str, word: str) -> list[int]:
    """Numbers of the scans that were reported as applied, or as durable."""
    return [int(line.split()[1]) for line in lines.splitlines() if line.startswith(word + " ")]


def assert_equal_to(reference: dict[Voxel, int], shm: Path, disk: Path) -> None:
    """Everything is on the disk, and all memory is given back but what is clean."""
    made, folder = opened(shm, disk, 10**9)
    assert voxels_on_disk(made.files, made) == reference
    assert not made.files.missing
    assert not made.files.damaged
    assert all(
        view.view.state["version"] == view.view.state["saved_version"] for view in made.chunks.values()
    )
    assert not [name for name in os.listdir(disk) if name.endswith(".tmp")]
    made.close()
    folder.close()


def test_a_drive_with_little_memory(shm: Path, tmp_path: Path, reference: dict[Voxel, int]) -> None:
    lines = run(shm, tmp_path, 1)
    assert said(lines, "evicted")[0] > 20
    assert said(lines, "most")[0] <= int(LITTLE[0])
    assert said(lines, "applied") == list(range(1, SCANS + 1))
    assert sorted(said(lines, "durable")) == list(range(1, SCANS + 1))
    assert_equal_to(reference, shm, tmp_path)


def finish(shm: Path, disk: Path, lines: str) -> str:
    """The mapper sends again what it has no answer for."""
    applied = said(lines, "applied")
    more = run(shm, disk, (max(applied) if applied else 0) + 1)
    assert more.endswith("done\n")
    return more


@pytest.mark.parametrize(
    ("label", "times"),
    [
        ("live.copied", 60),
        ("live.odd", 61),
        ("live.applied", 1),
        ("live.applied", 90),
        ("live.even", 97),
        ("live.map", 1),
        ("live.written", 9),
        ("live.synced", 1),
        ("live.renamed", 12),
        ("live.flushed", 1),
    ],
)
def test_a_writer_that_is_killed_at_any_step_loses_nothing(
    shm: Path, tmp_path: Path, reference: dict[Voxel, int], label: str, times: int
) -> None:
    lines = run(shm, tmp_path, 1, crash=f"{label}:{times}", code=-signal.SIGKILL)
    finish(shm, tmp_path, lines)
    assert_equal_to(reference, shm, tmp_path)


def test_a_writer_that_is_killed_at_any_time_loses_nothing(
    shm: Path, tmp_path: Path, reference: dict[Voxel, int]
) -> None:
    """Several times in a row, each after it has said something at random."""
    rng = random.Random(0)
    lines = ""
    for _ in range(4):
        applied = said(lines, "applied")
        first = str((max(applied) if applied else 0) + 1)
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.live_drive", str(shm), str(tmp_path), *LITTLE, first],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        for _ in range(rng.randint(0, 12)):
            lines += process.stdout.readline()
        process.kill()
        lines += process.stdout.read()
        process.wait()
        process.stdout.close()
    finish(shm, tmp_path, lines)
    assert_equal_to(reference, shm, tmp_path)


def test_what_was_all_but_given_up_comes_back_from_disk(
    monkeypatch: pytest.MonkeyPatch, shm: Path, tmp_path: Path, reference: dict[Voxel, int]
) -> None:
    """Out of service, its name still there: no reader may have it; and what cannot be opened stays."""
    run(shm, tmp_path, 1)
    name = max(shm.glob("shmmap-live.*_*"))
    made, folder = opened(shm, tmp_path, 10**9)
    key = next(key for key, chunk in made.chunks.items() if chunk.name == f"/{name.name}")
    made.chunks[key].view.state["state"] = OUT_OF_SERVICE
    made.close()
    folder.close()
    left = sorted(shm.iterdir())
    with monkeypatch.context() as patch:
        patch.setattr(ChunkMemory, "open", failing(errno.EMFILE))
        with pytest.raises(OSError, match="Too many open files"):
            opened(shm, tmp_path, 10**9)
    assert sorted(shm.iterdir()) == left
    made, folder = opened(shm, tmp_path, 10**9)
    assert key not in made.chunks
    assert not name.exists()
    made.close()
    folder.close()
    assert_equal_to(reference, shm, tmp_path)
