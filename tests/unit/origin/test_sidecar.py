# SPDX-License-Identifier: Apache-2.0
"""The cached catalogue: when it is used, when not, and what damage to it does (nothing)."""

from __future__ import annotations

import dataclasses
import logging
import os
import random
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shmmap.origin import map_directory
from shmmap.origin.catalogue import Catalogue, compare
from shmmap.origin.catalogue_bytes import default_cache_directory
from shmmap.origin.map_directory import MapDirectory, open_map

CELLS = 40


@pytest.fixture
def origin(tmp_path: Path) -> MapDirectory:
    """A map of 40 cells in two folders whose catalogue is worth caching."""
    for i in range(CELLS):
        folder = tmp_path / "map" / "pointcloud_map.pcd" / str(i % 2)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"c_{20 * i}_0.pcd").write_bytes(b"x" * i)
    lines = ["x_resolution: 20", "y_resolution: 20", "z_resolution: 5"]
    lines += [f"c_{20 * i}_0.pcd: [{20 * i}, 0]" for i in range(CELLS)]
    (tmp_path / "map" / "pointcloud_map_metadata.yaml").write_text("\n".join(lines) + "\n")
    settle(tmp_path / "map")
    return MapDirectory(path=str(tmp_path / "map"), cache_dir=str(tmp_path / "cache"), cached_from_cells=1)


def settle(root: Path) -> None:
    """Wait until the clock has left the newest change behind: only then is a catalogue cached."""
    newest = max(os.stat(path).st_ctime_ns for path in [root, *root.rglob("*")])
    while time.time_ns() < newest + 25_000_000:
        os.stat(root)


def sidecar(origin: MapDirectory) -> Path:
    (file,) = Path(origin.cache_dir).glob("*.catalogue")
    return file


def assert_equal(a: Catalogue, b: Catalogue) -> None:
    assert not compare(a, b)
    assert a.ids(np.arange(len(a))) == b.ids(np.arange(len(b)))
    assert a.problems == b.problems
    assert a.map_version == b.map_version


def rewrite_unseen(origin: MapDirectory) -> Path:
    """Rewrite a file in place, which no directory shows: only a look at the files does."""
    file = Path(origin.path) / "pointcloud_map.pcd" / "1" / "c_20_0.pcd"
    with open(file, "r+b") as out:
        out.write(b"y")
        out.truncate(77)
    return file


def test_comes_from_the_sidecar_while_nothing_changed(origin: MapDirectory) -> None:
    first = origin.load()
    assert_equal(first, origin.load())
    file = rewrite_unseen(origin)
    cached = origin.load()
    assert_equal(first, cached)
    index = cached.find(str(file))
    assert index is not None
    cached.set_stamp(index, cached.stamp(0))  # arrays from the sidecar are as good as fresh ones
    fresh = origin.load(fresh=True)
    assert compare(first, fresh).ids("changed") == (str(file),)
    assert fresh.source_bytes(index) == 77
    assert_equal(fresh, origin.load())


def touch_metadata(root: Path) -> None:
    with open(root / "pointcloud_map_metadata.yaml", "a") as out:
        out.write("# more\n")


def replace_cell(root: Path) -> None:
    (root / "new").write_bytes(b"new content")
    (root / "new").rename(root / "pointcloud_map.pcd" / "0" / "c_0_0.pcd")


def remove_cell(root: Path) -> None:
    (root / "pointcloud_map.pcd" / "1" / "c_20_0.pcd").unlink()


def add_folder(root: Path) -> None:
    (root / "pointcloud_map.pcd" / "2").mkdir()


def restore_metadata_times(root: Path) -> None:
    """Same size and mtime as before: only the ctime differs."""
    file = root / "pointcloud_map_metadata.yaml"
    status = file.stat()
    file.write_text(file.read_text().replace("[20, 0]", "[20, 9]"))
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))


@pytest.mark.parametrize(
    "change", [touch_metadata, replace_cell, remove_cell, add_folder, restore_metadata_times]
)
def test_any_visible_change_is_noticed(origin: MapDirectory, change: Callable[[Path], None]) -> None:
    origin.load()
    unseen = rewrite_unseen(origin)
    size = unseen.stat().st_size
    change(Path(origin.path))
    catalogue = origin.load()
    index = catalogue.find(str(unseen))
    # the files were looked at again, so the rewrite shows as well
    assert (index is None) == (change is remove_cell)
    assert index is None or catalogue.source_bytes(index) == size


def test_a_map_that_changed_just_now_is_not_cached(origin: MapDirectory) -> None:
    add_folder(Path(origin.path))
    future = time.time_ns() + 3_600_000_000_000
    os.utime(Path(origin.path) / "pointcloud_map.pcd" / "2", ns=(future, future))
    origin.load()
    assert list(Path(origin.cache_dir).glob("*")) == []


def test_settings_have_sidecars_of_their_own(origin: MapDirectory, tmp_path: Path) -> None:
    origin.load()
    copy = tmp_path / "other.yaml"
    copy.write_text("x_resolution: 10\ny_resolution: 10\nc_0_0.pcd: [0, 0]\n")
    settle(tmp_path)
    other = MapDirectory(
        path=origin.path, metadata=str(copy), cache_dir=origin.cache_dir, cached_from_cells=1
    )
    assert len(other.load()) == 1
    assert len(origin.load()) == CELLS
    assert len(other.load()) == 1
    assert len(list(Path(origin.cache_dir).glob("*.catalogue"))) == 2


def test_small_maps_and_single_files_are_not_cached(origin: MapDirectory) -> None:
    small = MapDirectory(path=origin.path, cache_dir=origin.cache_dir)
    small.load()
    assert not os.path.exists(origin.cache_dir)


def test_every_kind_of_damage_is_noticed(origin: MapDirectory, caplog: pytest.LogCaptureFixture) -> None:
    truth = origin.load()
    file = sidecar(origin)
    sound = file.read_bytes()
    rng = random.Random(5)
    damaged = [b"", sound[:7], sound[:23], sound[:24], sound[:-1], sound + b"\0", bytes(len(sound))]
    for _ in range(200):
        at = rng.randrange(len(sound))
        damaged.append(sound[:at] + bytes([sound[at] ^ (1 << rng.randrange(8))]) + sound[at + 1 :])
    for data in damaged:
        file.write_bytes(data)
        caplog.clear()
        assert_equal(truth, origin.load())
        assert any("damaged catalogue cache ignored" in message for message in caplog.messages)
        assert file.read_bytes() == sound  # written again
    file.unlink()
    file.mkdir()
    caplog.clear()
    assert_equal(truth, origin.load())
    assert any("catalogue cache cannot be read" in message for message in caplog.messages)


def test_unwritable_cache_directory_costs_only_a_warning(
    origin: MapDirectory, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    blocked = MapDirectory(path=origin.path, cache_dir=str(tmp_path / "file" / "x"), cached_from_cells=1)
    with caplog.at_level(logging.WARNING):
        assert len(blocked.load()) == CELLS
    assert any("catalogue not cached" in message for message in caplog.messages)


def test_nothing_half_written_stays_behind(origin: MapDirectory, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shmmap.origin.catalogue_bytes.os.replace", refuse)
    assert len(origin.load()) == CELLS
    assert os.listdir(origin.cache_dir) == []


def test_where_the_cache_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    assert default_cache_directory() == str(tmp_path / ".cache" / "shmmap")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert default_cache_directory() == str(tmp_path / ".cache" / "shmmap")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert default_cache_directory() == str(tmp_path / "xdg" / "shmmap")
    monkeypatch.setenv("CACHE_DIRECTORY", "/var/cache/shmmap:/var/cache/other")
    assert default_cache_directory() == "/var/cache/shmmap"
    (tmp_path / "map").mkdir()
    assert open_map(tmp_path / "map").cache_dir == "/var/cache/shmmap"


def test_a_large_map_is_read_again_in_a_process_of_its_own(
    origin: MapDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its changes are seen and kept in the cache, and nothing is parsed here."""
    first = origin.load()
    file = rewrite_unseen(origin)
    settle(Path(origin.path))
    monkeypatch.setattr(map_directory, "scan", None)
    monkeypatch.setattr(map_directory, "_READ_HERE_BYTES", 1)
    fresh = origin.load(fresh=True, before=first)
    assert compare(first, fresh).ids("changed") == (str(file),)
    assert_equal(fresh, origin.load())
    few = dataclasses.replace(origin, cached_from_cells=CELLS + 1)
    assert compare(first, few.load(fresh=True)).ids("changed") == (str(file),)
    Path(origin.path, "pointcloud_map_metadata.yaml").unlink()
    with pytest.raises(TypeError):  # without metadata there is nothing to read apart
        origin.load(fresh=True)


@pytest.mark.parametrize("plant", ["writable", "link", "pipe"])
def test_a_sidecar_that_another_account_may_have_written_is_not_used(
    origin: MapDirectory, plant: str
) -> None:
    origin.load()
    rewrite_unseen(origin)
    file = sidecar(origin)
    if plant == "writable":
        file.chmod(0o666)
    elif plant == "link":
        file.rename(file.with_suffix(".aside"))
        file.symlink_to(file.with_suffix(".aside"))
    else:
        file.unlink()
        os.mkfifo(file)
    found = origin.load()
    index = found.find(str(Path(origin.path) / "pointcloud_map.pcd" / "1" / "c_20_0.pcd"))
    assert index is not None
    assert found.source_bytes(index) == 77
