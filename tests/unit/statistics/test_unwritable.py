# SPDX-License-Identifier: Apache-2.0
"""What may not be written is written as soon as it can be; names that others have."""

from __future__ import annotations

import contextlib
import os
import pwd
import resource
from collections.abc import Iterator
from dataclasses import replace

import pytest

from shmmap.errors import CannotStart
from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.counters import COUNTERS, HISTOGRAMS
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.layout import CHANGES, plan
from shmmap.statistics.reader import read_statistics
from shmmap.statistics.writer import StatisticsWriter


@contextlib.contextmanager
def files_no_larger_than(nbytes: int) -> Iterator[None]:
    """Let writes beyond ``nbytes`` of any file fail (EFBIG; Python ignores SIGXFSZ)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (nbytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_what_cannot_be_written_is_written_as_soon_as_it_can(
    shm: ShmDirectory, writer: StatisticsWriter, identity: DaemonIdentity, caplog: pytest.LogCaptureFixture
) -> None:
    """Wherever the limit lies, also in the midst of a block; what was whole stays readable throughout."""
    layout = plan(COUNTERS, HISTOGRAMS)
    limits = [
        0,
        layout.identity_offset + 100,
        layout.state_offset + 100,
        layout.state_offset + layout.state_bytes + 100,
        layout.changes_offset,
        layout.changes_offset + 8,
    ]
    for turn, limit in enumerate(limits, 1):
        with files_no_larger_than(limit):
            for version in (turn - 1, turn):
                writer.update_identity(replace(identity, map_version=100 + version))
            writer.map_changed()
            writer.add("requests")
            for _ in range(3):
                writer.beat()
            assert read_statistics("unit", shm.path).state == "healthy"
        writer.beat()
        seen = read_statistics("unit", shm.path)
        assert seen.identity == replace(identity, map_version=100 + turn)
        assert seen.counters["requests"] == turn
        with open(f"{shm.path}/shmmap.unit.statistics", "rb") as file:
            assert CHANGES.unpack(os.pread(file.fileno(), CHANGES.size, layout.changes_offset))[1] == 1 + turn
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "File too large" in caplog.text


def test_a_successor_s_are_never_taken_away(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    old = StatisticsWriter(shm, "unit", identity)
    old.add("requests", 1)
    os.unlink(f"{shm.path}/shmmap.unit.statistics")  # else there could be none
    new = StatisticsWriter(shm, "unit", replace(identity, epoch=2))
    old.beat()
    seen = read_statistics("unit", shm.path)
    assert seen.identity is not None
    assert (seen.identity.epoch, seen.counters["requests"]) == (2, 0)
    old.close()
    assert read_statistics("unit", shm.path).state == "healthy"
    new.close()
    assert read_statistics("unit", shm.path).state == "absent"
    assert os.listdir(shm.path) == []


def test_too_long_an_identity_is_refused(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    with pytest.raises(ValueError, match="does not fit"):
        StatisticsWriter(shm, "unit", replace(identity, map_path="/" + "x" * 20000))
    assert os.listdir(shm.path) == []


def test_a_name_that_another_file_has(shm: ShmDirectory, identity: DaemonIdentity) -> None:
    """A directory stands for another account's file: it cannot be replaced either."""
    path = f"{shm.path}/shmmap.unit.statistics"
    os.mkdir(path)
    with pytest.raises(CannotStart) as failure:
        StatisticsWriter(shm, "unit", identity)
    user = pwd.getpwuid(os.geteuid()).pw_name
    assert failure.value.message == (
        f"the statistics cannot be {path}: there is a directory of user {user} (uid {os.geteuid()})"
        " (Is a directory)"
    )
    assert f"`sudo rm -r {path}`" in failure.value.hint
    assert os.listdir(shm.path) == ["shmmap.unit.statistics"]
    os.rmdir(path)
