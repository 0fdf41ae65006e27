# SPDX-License-Identifier: Apache-2.0
"""A check of a live map finds whatever is not as it was written, and a repair destroys nothing."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from shmmap.chunks.chunk_file import encode_chunk
from shmmap.chunks.layout import ChunkView, new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import MapDataError
from shmmap.live_worker.disk.folder import Folder, FolderToRead
from shmmap.live_worker.disk.maintenance import CheckedMap, check, repair, reset
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.stored_map import StoredMap, opened_folder, opened_folder_to_read
from tests.support.live_drive import SETTINGS
from tests.support.live_reference import contents, stored_drive
from tests.support.stored_chunks import change_chunk, chunk_sizes, largest, saved_bytes


def checked_as_it_is(directory: Path) -> CheckedMap:
    """Check a map as everybody may."""
    with opened_folder_to_read(str(directory)) as folder:
        return check(folder, str(directory))


def checked(directory: Path) -> CheckedMap:
    """Check a map, which changes nothing."""
    before = contents(directory)
    found = checked_as_it_is(directory)
    assert contents(directory) == before
    return found


def repaired(directory: Path) -> CheckedMap:
    with opened_folder(str(directory), "") as folder:
        found = check(folder, str(directory))
        repair(folder, found)
    return found


@pytest.mark.parametrize("codec", ["raw", "zlib"])
def test_a_good_map(tmp_path: Path, codec: str) -> None:
    voxels = stored_drive(tmp_path, codec=codec)
    found = checked(tmp_path)
    assert found.good
    assert found.total("active") == len(voxels)
    assert found.total("occupied") == sum(value > 0 for value in voxels.values())
    assert found.total("free") == sum(value < 0 for value in voxels.values())
    sizes = chunk_sizes(tmp_path)
    assert len(found.rows) == len(sizes) > 5
    assert found.total("bytes") == sum(sizes.values())
    assert (found.resolution, found.frame_id) == (0.2, "map")
    before = contents(tmp_path)
    assert repaired(tmp_path).good
    assert contents(tmp_path) == before


def assert_found_and_put_aside(directory: Path, key: ChunkKey, damaged: bytes) -> None:
    """The chunk is the only one that is lost, and its bytes are kept."""
    change_chunk(directory, key, lambda _data: damaged)
    whole = (directory / "map.db").read_bytes()
    assert not checked(directory).good
    found = repaired(directory)
    assert [one.chunk for one in found.lost] == [key.text]
    assert (directory / found.rebuilt_from).read_bytes() == whole
    again = checked(directory)
    assert again.good
    assert key not in again.rows
    assert found.rebuilt_from in again.aside
    with closing(Folder(directory)) as folder, closing(MapDatabase(folder, SETTINGS)) as database:
        assert database.rows == again.rows
        assert not database.record.lost_chunks


def test_a_chunk_that_contradicts_itself(tmp_path: Path) -> None:
    """Its checksums are right, and its counters are not those of its voxels."""
    stored_drive(tmp_path, 1)
    key = largest(tmp_path)
    view = ChunkView(new_header(SETTINGS.identity(bytes.fromhex(checked(tmp_path).map_id), key, 1)))
    view.state["active"] = 7
    change_chunk(tmp_path, key, lambda _data: encode_chunk(view, "raw"))
    assert [one.chunk for one in checked(tmp_path).lost] == [key.text]


def test_a_chunk_of_another_map(tmp_path: Path) -> None:
    stored_drive(tmp_path / "one")
    stored_drive(tmp_path / "other")
    first, second = list(chunk_sizes(tmp_path / "one"))[-2:]
    assert_found_and_put_aside(tmp_path / "one", first, b"damaged")
    assert_found_and_put_aside(tmp_path / "one", second, saved_bytes(tmp_path / "other", second))
    assert checked(tmp_path / "one").aside == ["map.db.damaged.1", "map.db.damaged.2"]


def test_while_a_daemon_works_with_it(tmp_path: Path) -> None:
    """What is committed is read, and nothing is waited for; a check has no part in the daemon's locks."""
    stored_drive(tmp_path)
    with closing(Folder(tmp_path)) as folder, closing(MapDatabase(folder, SETTINGS)) as database:
        key = largest(tmp_path)
        view = ChunkView(new_header(SETTINGS.identity(database.map_id, key, 1)))
        for version in range(100, 103):
            view.state["version"] = version
            database.save(key, encode_chunk(view, "raw"))
            found = check_in_another_process(tmp_path)
            assert f"{len(database.rows)} chunks" in found
        database.bring_log_in()
        assert (tmp_path / "map.db-wal").stat().st_size == 0
        assert "good" in check_in_another_process(tmp_path)


def check_in_another_process(directory: Path) -> str:
    words = [sys.executable, "-m", "shmmap.cli", "live", "fsck", "--read-only", str(directory)]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout


def test_a_daemon_that_begins_while_the_map_is_read(tmp_path: Path) -> None:
    """Without a log the database is read as a file without a writer; then it is opened again."""
    stored_drive(tmp_path)
    with closing(FolderToRead(tmp_path)) as folder, closing(StoredMap(folder, str(tmp_path))) as stored:
        assert contents(tmp_path).keys() == {"map.db", "map.json"}, "reading makes no log"
        with closing(Folder(tmp_path)) as locked, closing(MapDatabase(locked, SETTINGS)) as database:
            for version in range(2000, 2100):
                for key in database.rows:
                    view = ChunkView(new_header(SETTINGS.identity(database.map_id, key, 1)))
                    view.state["version"] = version
                    database.save(key, encode_chunk(view, "raw"))
            database.bring_log_in()
            for key in stored.rows:
                assert stored.chunk(key) is not None


def test_a_map_without_its_database(tmp_path: Path) -> None:
    stored_drive(tmp_path)
    (tmp_path / "map.db").unlink()
    with (
        pytest.raises(MapDataError, match="database with the chunks is missing"),
        opened_folder_to_read(str(tmp_path)),
    ):
        pass


# --- resetting ----------------------------------------------------------------------------------


OTHERS = {"notes.txt": b"mine", ".hidden.tmp": b"mine"}
LEFT_OVER = [".0_0_0.chunk.abcd.tmp", ".map.json.abcd.tmp", "map.db.damaged.1", "map.db.new", "9_9_9.chunk"]


def lived_in(directory: Path) -> dict[str, bytes]:
    """Make a map with all kinds of files of its own, and some of others; returns its own."""
    stored_drive(directory, 2)
    for name in LEFT_OVER:
        (directory / name).write_bytes(b"left")
    own = contents(directory)
    for name, data in OTHERS.items():
        (directory / name).write_bytes(data)
    return own


def test_a_reset_moves_the_map_s_files(tmp_path: Path) -> None:
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
        moved = Folder(tmp_path / f"reset.{number}")
        assert check(moved, "").good
        moved.close()


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
            assert check(folder, "").good
        else:
            assert steps >= len(own)
            assert not delete or contents(directory) == OTHERS
            return
        finally:
            folder.close()
    raise AssertionError("it never came to its end")
