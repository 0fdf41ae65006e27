# SPDX-License-Identifier: Apache-2.0
"""A live map is begun anew, and what it was is a live map still, or gone."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmmap.daemon.live.disk.checking import check
from shmmap.daemon.live.disk.resetting import reset
from shmmap.daemon.live.folder import Folder
from shmmap.daemon.live.map_files import MapFiles
from tests.support.live_drive import SETTINGS
from tests.support.live_reference import contents, stored_drive

OTHERS = {"notes.txt": b"mine", ".hidden.tmp": b"mine"}
LEFT_OVER = [".0_0_0.chunk.abcd.tmp", ".map.json.abcd.tmp", "9_9_9.chunk.damaged.1", "odd.chunk"]


def lived_in(directory: Path) -> dict[str, bytes]:
    """Make a map with all kinds of files of its own, and some of others; returns its own."""
    stored_drive(directory, 2)
    for name in LEFT_OVER:
        (directory / name).write_bytes(b"left")
    own = contents(directory)
    for name, data in OTHERS.items():
        (directory / name).write_bytes(data)
    return own


def test_moved_aside(tmp_path: Path) -> None:
    for number in (1, 2):
        own = lived_in(tmp_path)
        own = {name: data for name, data in own.items() if "/" not in name and name not in OTHERS}
        folder = Folder(tmp_path)
        done = reset(folder, delete=False)
        folder.close()
        assert done.moved_to == str(tmp_path / f"reset.{number}")
        assert (done.files, done.bytes) == (len(own), sum(map(len, own.values())))
        assert contents(tmp_path / f"reset.{number}") == own
        assert {path.name for path in tmp_path.iterdir() if path.is_file()} == OTHERS.keys()
        aside = Folder(tmp_path / f"reset.{number}")
        assert check(aside, "").good
        aside.close()


def test_deleted(tmp_path: Path) -> None:
    own = lived_in(tmp_path)
    folder = Folder(tmp_path)
    done = reset(folder, delete=True)
    assert (done.moved_to, done.files) == ("", len(own))
    assert contents(tmp_path) == OTHERS
    assert MapFiles(folder, SETTINGS).rows == {}
    folder.close()


@pytest.mark.parametrize("delete", [False, True])
def test_killed_at_any_moment_it_is_a_live_map_of_which_nothing_is_missing(
    tmp_path: Path, delete: bool
) -> None:
    class Killed(Folder):
        left = 0

        def _count(self) -> None:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt

        def rename(self, old: str, new: str) -> None:
            self._count()
            super().rename(old, new)

        def remove(self, name: str) -> None:
            self._count()
            super().remove(name)

    for steps in range(1, 40):
        directory = tmp_path / str(steps)
        own = lived_in(directory)
        folder = Killed(directory)
        folder.left = steps
        try:
            reset(folder, delete=delete)
        except KeyboardInterrupt:
            found = check(folder, "")
            assert found.good
            assert not found.missing
        else:
            assert steps >= len(own)
            return
        finally:
            folder.close()
    raise AssertionError("it never came to its end")
