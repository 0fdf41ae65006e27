# SPDX-License-Identifier: Apache-2.0
"""A check of a live map finds whatever is not as it was written, and a repair destroys nothing."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from shmmap.chunks.chunk_file import encode_chunk
from shmmap.chunks.layout import ChunkView, new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.disk.folder import Folder, FolderToRead
from shmmap.daemon.live.disk.maintenance import CheckedMap, check, repair, reset
from shmmap.daemon.live.disk.map_files import MapFiles
from shmmap.daemon.live.disk.map_record import Listed, write_rows
from shmmap.daemon.live.disk.stored_map import opened_folder, opened_folder_to_read
from shmmap.errors import MapDataError
from tests.support.live_drive import SETTINGS
from tests.support.live_reference import contents, stored_drive
from tests.support.odd_files import ODD_FILES


def checked_as_it_is(directory: Path) -> CheckedMap:
    """Check a map as everybody may."""
    with opened_folder_to_read(str(directory)) as files:
        return check(files, str(directory))


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


def largest(directory: Path) -> Path:
    return max(directory.glob("*.chunk"), key=lambda path: path.stat().st_size)


@pytest.mark.parametrize("codec", ["raw", "zlib"])
def test_a_good_map(tmp_path: Path, codec: str) -> None:
    voxels = stored_drive(tmp_path, codec=codec)
    found = checked(tmp_path)
    assert found.good
    assert found.manifest == "current"
    assert found.total("active") == len(voxels)
    assert found.total("occupied") == sum(value > 0 for value in voxels.values())
    assert found.total("free") == sum(value < 0 for value in voxels.values())
    files = list(tmp_path.glob("*.chunk"))
    assert len(found.rows) == len(files) > 5
    assert found.total("bytes") == sum(path.stat().st_size for path in files)
    assert (found.resolution, found.frame_id) == (0.2, "map")
    assert [*found.interim, *found.quarantined, *found.strange, *found.unreadable] == []
    before = contents(tmp_path)
    assert repaired(tmp_path).good
    assert contents(tmp_path) == before


def assert_found_and_quarantined(directory: Path, path: Path, damaged: bytes) -> None:
    """The file is the only one that is damaged, and its bytes are kept."""
    path.write_bytes(damaged)
    found = repaired(directory)
    assert [one.file for one in found.damaged] == [path.name]
    assert not found.good
    assert not path.exists()
    kept = path.with_name(found.damaged[0].kept_as)
    assert kept.read_bytes() == damaged
    kept.unlink()


def small_map(directory: Path) -> tuple[Path, bytes]:
    """A map of one small chunk: its file, and what is in it."""
    stored_drive(directory, 1)
    keep = min(directory.glob("*.chunk"), key=lambda path: path.stat().st_size)
    for path in directory.glob("*.chunk"):
        if path != keep:
            path.unlink()
    return keep, keep.read_bytes()


def test_a_file_that_contradicts_itself(tmp_path: Path) -> None:
    """Its checksums are right, and its counters are not those of its voxels."""
    path, _ = small_map(tmp_path)
    files = MapFiles(folder := Folder(tmp_path), SETTINGS)
    key = ChunkKey.from_text(path.name.removesuffix(".chunk"))
    view = ChunkView(new_header(SETTINGS.identity(files.map_id, key, 1)))
    view.state["active"] = 7
    folder.close()
    assert_found_and_quarantined(tmp_path, path, encode_chunk(view, "raw"))


def test_a_file_of_another_chunk_or_map(tmp_path: Path) -> None:
    stored_drive(tmp_path / "one")
    stored_drive(tmp_path / "other")
    first, second = sorted((tmp_path / "one").glob("*.chunk"))[:2]
    assert_found_and_quarantined(tmp_path / "one", first, second.read_bytes())
    assert_found_and_quarantined(tmp_path / "one", second, (tmp_path / "other" / second.name).read_bytes())


def test_what_is_quarantined_never_takes_the_place_of_another(tmp_path: Path) -> None:
    stored_drive(tmp_path)
    path = largest(tmp_path)
    for number in (1, 2, 3):
        path.write_bytes(b"%d" % number)
        assert repaired(tmp_path).damaged[0].kept_as == f"{path.name}.damaged.{number}"
    found = checked(tmp_path)
    assert found.good
    assert found.manifest == "current"
    assert found.quarantined == [f"{path.name}.damaged.{number}" for number in (1, 2, 3)]
    assert [(tmp_path / name).read_bytes() for name in found.quarantined] == [b"1", b"2", b"3"]
    files = MapFiles(Folder(tmp_path), SETTINGS)
    assert files.rows == found.rows
    assert not files.missing


def test_chunks_that_are_missing(tmp_path: Path) -> None:
    stored_drive(tmp_path)
    path = largest(tmp_path)
    path.unlink()
    key = path.name.removesuffix(".chunk")
    (lost,) = checked(tmp_path).missing
    assert (lost.chunk, lost.found) == (key, 0)
    assert lost.version > 0
    assert not checked(tmp_path).good
    assert repaired(tmp_path).missing == [lost]
    assert checked(tmp_path).good


def save_newer(folder: Folder, path: Path) -> tuple[ChunkKey, int]:
    """Save another state of a chunk, and list it; returns the chunk and that version."""
    files = MapFiles(folder, SETTINGS)
    key = ChunkKey.from_text(path.name.removesuffix(".chunk"))
    version = files.rows[key].version + 5
    view = ChunkView(new_header(SETTINGS.identity(files.map_id, key, 1)))
    view.state["version"] = version
    files.save(key, encode_chunk(view, "raw"))
    files.write_manifest()
    return key, version


def test_a_chunk_of_which_only_an_older_state_is_there(tmp_path: Path) -> None:
    stored_drive(tmp_path)
    path = largest(tmp_path)
    old = path.read_bytes()
    folder = Folder(tmp_path)
    key, version = save_newer(folder, path)
    folder.close()
    path.write_bytes(old)
    (lost,) = checked(tmp_path).missing
    assert (lost.chunk, lost.version, lost.found) == (key.text, version, version - 5)


def test_a_chunk_that_is_saved_while_the_map_is_checked(tmp_path: Path) -> None:
    """A newer state of it is listed then than was read: nothing is missing."""
    stored_drive(tmp_path)
    path = largest(tmp_path)
    folder = Folder(tmp_path)

    class Saving(FolderToRead):
        saved = False

        def read(self, name: str, most: int = -1) -> bytes:
            data = super().read(name, most)
            if name == path.name and not self.saved:
                self.saved = True
                save_newer(folder, path)
            return data

    files = Saving(tmp_path)
    assert check(files, str(tmp_path)).good
    assert files.saved
    files.close()


def _remove(manifest: Path) -> None:
    manifest.unlink()


def _spoil(manifest: Path) -> None:
    manifest.write_bytes(manifest.read_bytes()[:-9])


def _forget_one(manifest: Path) -> None:
    folder = Folder(manifest.parent)
    rows = dict(MapFiles(folder, SETTINGS).rows)
    rows.popitem()
    write_rows(folder, Listed(rows, {}, {}))
    folder.close()


@pytest.mark.parametrize(
    ("change", "manifest", "good"),
    [(_remove, "absent", True), (_spoil, "unreadable", False), (_forget_one, "stale", True)],
)
def test_the_manifest(tmp_path: Path, change: Callable[[Path], None], manifest: str, good: bool) -> None:
    stored_drive(tmp_path)
    change(tmp_path / "manifest.json")
    found = checked(tmp_path)
    assert (found.manifest, found.good, found.rewritten) == (manifest, good, False)
    assert repaired(tmp_path).rewritten
    assert checked(tmp_path).manifest == "current"
    assert checked(tmp_path).good


@pytest.mark.parametrize("what", [".chunk", "manifest.json", ".chunk.abcd.tmp"])
@pytest.mark.parametrize(
    "kind", ["pipe", "directory", "loop", pytest.param("device", marks=pytest.mark.root)]
)
def test_what_cannot_be_read_is_quarantined(tmp_path: Path, what: str, kind: str) -> None:
    """It may be as good as ever: a check changes nothing, and a repair gives it another name."""
    stored_drive(tmp_path)
    path = largest(tmp_path) if what == ".chunk" else tmp_path / what
    if path.exists():
        path.rename(tmp_path / "elsewhere")
    ODD_FILES[kind](path)
    found = checked_as_it_is(tmp_path)
    if what == "manifest.json":
        assert found.manifest == "unreadable"
    else:
        assert list(found.unreadable) == [path.name]
    assert (found.good, path.lstat().st_size) == (False, path.lstat().st_size)
    found = repaired(tmp_path)
    (quarantined,) = found.damaged
    assert (quarantined.file, quarantined.kept_as) == (path.name, f"{path.name}.damaged.1")
    assert (tmp_path / quarantined.kept_as).lstat()
    assert not path.exists() or what == "manifest.json"
    assert found.rewritten == (what != ".chunk.abcd.tmp")
    again = checked_as_it_is(tmp_path)
    assert (again.good, again.manifest, again.quarantined) == (True, "current", [quarantined.kept_as])
    with opened_folder(str(tmp_path), "") as folder:
        MapFiles(folder, SETTINGS)


def test_what_is_only_there_to_be_written_over_is_not_reported(tmp_path: Path) -> None:
    stored_drive(tmp_path)
    path = largest(tmp_path)
    (tmp_path / ".chunk.abcd.tmp").write_bytes(path.read_bytes())
    assert checked(tmp_path).interim == []
    path.unlink()
    assert checked(tmp_path).interim == [".chunk.abcd.tmp"], "the next start takes it over"


def test_files_that_are_no_chunks(tmp_path: Path) -> None:
    stored_drive(tmp_path)
    names = [".0_0_0.chunk.abcd.tmp", "0_0.chunk", "9_9_9.chunk.damaged.1", "notes.txt"]
    for name in names:
        (tmp_path / name).write_bytes(b"mine")
    found = repaired(tmp_path)
    assert found.good
    assert (found.interim, found.strange, found.quarantined) == (names[:1], names[1:2], names[2:3])
    assert all((tmp_path / name).read_bytes() == b"mine" for name in names)


def test_what_is_no_live_map_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "0_0_0.chunk").write_bytes(b"x")
    with pytest.raises(MapDataError, match="chunks, but no map"), opened_folder_to_read(str(tmp_path)):
        pass
    (tmp_path / "map.json").write_bytes(b"{")
    with opened_folder_to_read(str(tmp_path)) as files, pytest.raises(MapDataError) as caught:
        check(files, str(tmp_path))
    assert str(tmp_path) in caught.value.message
    assert "live reset" in caught.value.hint
    assert contents(tmp_path) == {"0_0_0.chunk": b"x", "map.json": b"{"}


def test_a_file_that_goes_while_the_map_is_checked(tmp_path: Path) -> None:
    """A daemon has quarantined it: it is missing, and not damaged."""
    stored_drive(tmp_path)
    gone = largest(tmp_path)

    class Going(FolderToRead):
        def names(self) -> list[str]:
            names = super().names()
            if gone.exists():
                os.rename(gone, tmp_path / f"{gone.name}.damaged.1")
            return names

    files = Going(tmp_path)
    found = check(files, str(tmp_path))
    files.close()
    assert [*found.damaged, *found.unreadable] == []
    assert [lost.chunk for lost in found.missing] == [gone.name.removesuffix(".chunk")]


# --- resetting ----------------------------------------------------------------------------------


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
            found = check(folder, "")
            assert found.good
            assert not found.missing
        else:
            assert steps >= len(own)
            assert not delete or contents(directory) == OTHERS
            return
        finally:
            folder.close()
    raise AssertionError("it never came to its end")
