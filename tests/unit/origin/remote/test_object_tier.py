# SPDX-License-Identifier: Apache-2.0
"""The disk tier: right bytes or none, whatever lies there; nothing that the disk does is an error."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import random
import resource
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from shmmap.disk_budget import DiskBudget
from shmmap.errors import MapDataError, MapMissing, Offline
from shmmap.origin.remote.object_tier import KeptObjects, ObjectCounts, ObjectTier
from shmmap.origin.remote.opened_store import DirectoryStore
from shmmap.origin.remote.published_object import blob_path
from shmmap.statistics.counters import OBJECTS_READ
from tests.support.interleaving import interleaved
from tests.support.map_stores import wait_for_trimming

DATA = random.Random(1).randbytes(20_000)
NAME = hashlib.sha256(DATA).digest()
OTHER = bytes(32)
DAY_S = 86_400


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


@pytest.fixture
def tier(cache: Path) -> ObjectTier:
    return ObjectTier(str(cache), limit_bytes=1 << 30)


def path_of(cache: Path, name: bytes = NAME, place: str = "cells") -> Path:
    return cache / "objects" / place / name.hex()[:2] / name.hex()


@pytest.mark.parametrize("is_index", [False, True])
def test_an_object_comes_back(cache: Path, tier: ObjectTier, is_index: bool) -> None:
    assert tier.get(NAME, len(DATA), is_index=is_index) is None
    assert not cache.exists(), "looking makes nothing"
    assert tier.put(NAME, memoryview(DATA), is_index=is_index)
    assert tier.get(NAME, len(DATA), is_index=is_index) == DATA
    assert ObjectTier(str(cache), limit_bytes=1 << 30).get(NAME, len(DATA), is_index=is_index) == DATA
    file = path_of(cache, place="index" if is_index else "cells")
    assert file.read_bytes() == DATA
    assert [file.parent.parent.parent.stat().st_mode & 0o777, file.stat().st_mode & 0o777] == [0o700, 0o600]
    assert len([path for path in cache.rglob("*") if path.is_file()]) == 1
    assert tier.put(NAME, DATA, is_index=is_index), "once more, as another process may at the same time"
    assert tier.problem == ""
    assert tier.get(NAME, len(DATA) - 1, is_index=is_index) is None, "a size that is not its own"


def test_nothing_is_kept_without_a_budget(cache: Path) -> None:
    for limit in (0, len(DATA) - 1):
        tier = ObjectTier(str(cache), limit_bytes=limit)
        assert not tier.put(NAME, DATA)
        assert not cache.exists()


# --- what lies there ----------------------------------------------------------------------------------


def flip(file: Path) -> None:
    file.write_bytes(DATA[:-1] + bytes([DATA[-1] ^ 1]))


def link(file: Path) -> None:
    file.rename(file.with_name("elsewhere"))
    file.symlink_to("elsewhere")


def loop(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.name)


def pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def unix_socket(file: Path) -> None:
    file.unlink()
    here = os.open(file.parent, os.O_PATH)
    with socket.socket(socket.AF_UNIX) as one:
        try:
            one.bind(f"/proc/self/fd/{here}/s")
        finally:
            os.close(here)
    file.with_name("s").rename(file)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "zeros": lambda file: file.write_bytes(bytes(len(DATA))),  # what a power cut may leave
    "flipped": flip,
    "of another object": lambda file: file.write_bytes(DATA[::-1]),
    "short": lambda file: os.truncate(file, 100),
    "empty": lambda file: os.truncate(file, 0),
    "long": lambda file: file.write_bytes(DATA + b"x"),
    "huge": lambda file: os.truncate(file, 1 << 40),
    "link": link,
    "loop": loop,
    "pipe": pipe,
    "socket": unix_socket,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_is_not_that_object_is_removed_and_replaced(cache: Path, tier: ObjectTier, damage: str) -> None:
    tier.put(NAME, DATA)
    DAMAGES[damage](path_of(cache))
    assert tier.get(NAME, len(DATA)) is None
    assert tier.damaged_objects == 1
    assert not os.path.lexists(path_of(cache))
    assert tier.get(NAME, len(DATA)) is None
    assert tier.damaged_objects == 1
    assert tier.put(NAME, DATA)
    assert tier.get(NAME, len(DATA)) == DATA


def test_a_directory_in_its_place_is_no_error(
    cache: Path, tier: ObjectTier, caplog: pytest.LogCaptureFixture
) -> None:
    (path_of(cache) / "inside").mkdir(parents=True)
    (cache / "objects").chmod(0o700)
    for _ in range(3):
        assert tier.get(NAME, len(DATA)) is None
        assert not tier.put(NAME, DATA)
    assert 1 <= caplog.text.count("objects not kept on disk") <= 2
    assert (path_of(cache) / "inside").is_dir()
    assert not list(cache.rglob(".new-*"))


def test_swapped_while_it_is_read_never_matters(cache: Path, tier: ObjectTier) -> None:
    """Another program rewrites, truncates and replaces the file all the time: right bytes, or none."""
    file, stop, found = path_of(cache), threading.Event(), {DATA: 0, None: 0}
    tier.put(NAME, DATA)

    def disturb() -> None:
        random_ = random.Random(5)
        while not stop.is_set():
            interim = file.with_name("other")
            interim.write_bytes(DATA[: random_.randrange(len(DATA))].ljust(len(DATA), b"\0"))
            if random_.random() < 0.5:
                interim.rename(file)
            with file.open("r+b") as opened:
                opened.write(DATA)
                opened.truncate(random_.choice([len(DATA), 100]))

    file.parent.joinpath("other").write_bytes(b"")
    thread = threading.Thread(target=_until_stopped, args=(disturb, stop))
    thread.start()
    try:
        for _ in range(300):
            data = tier.get(NAME, len(DATA))
            found[data] += 1  # a KeyError: wrong bytes
            tier.put(NAME, DATA)
    finally:
        stop.set()
        thread.join()
    assert found[DATA]


def _until_stopped(disturb: Callable[[], None], stop: threading.Event) -> None:
    while not stop.is_set():
        with suppress(FileNotFoundError):  # it was removed as damaged
            disturb()


# --- what the disk does -------------------------------------------------------------------------------


def test_removed_at_any_moment(cache: Path, tier: ObjectTier) -> None:
    for place in (cache, cache / "objects", path_of(cache).parent, path_of(cache)):
        assert tier.put(NAME, DATA)
        shutil.rmtree(place) if place.is_dir() else place.unlink()
        assert tier.get(NAME, len(DATA)) is None
        tier.mark_index_used([NAME])
        assert tier.put(NAME, DATA)
        assert tier.get(NAME, len(DATA)) == DATA


def test_a_disk_that_takes_no_more(cache: Path, tier: ObjectTier, caplog: pytest.LogCaptureFixture) -> None:
    small = DATA[:500]
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        for _ in range(3):
            assert not tier.put(NAME, DATA)
        assert tier.put(hashlib.sha256(small).digest(), small)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caplog.text.count("objects not kept on disk") == 1
    assert "File too large" in caplog.text
    assert not list(cache.rglob(".new-*"))
    assert tier.put(NAME, DATA), "there is room again"


def test_a_file_where_a_directory_should_be(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "cache").write_text("a file")
    tier = ObjectTier(str(tmp_path / "cache"), limit_bytes=1 << 30)
    for _ in range(2):
        assert tier.get(NAME, len(DATA)) is None
        assert not tier.put(NAME, DATA)
    assert caplog.text.count("objects not kept on disk") <= 2
    assert tier.problem
    quiet = ObjectTier(str(tmp_path / "cache"), limit_bytes=1 << 30, quiet=True)
    caplog.clear()
    assert not quiet.put(NAME, DATA)
    assert not caplog.text


def test_no_descriptor_is_left_open(cache: Path, tier: ObjectTier) -> None:
    tier.put(NAME, DATA)
    before = len(os.listdir("/proc/self/fd"))
    changes: list[Callable[[], object]] = [
        lambda: None,
        lambda: (cache / "objects").chmod(0o777),
        lambda: shutil.rmtree(cache),
    ]
    for change in changes:
        change()
        for _ in range(20):
            tier.get(NAME, len(DATA))
            tier.put(NAME, DATA, is_index=True)
    assert len(os.listdir("/proc/self/fd")) <= before


def test_damage_that_is_found_at_the_same_time_all_counts(cache: Path, tier: ObjectTier) -> None:
    def damaged() -> ObjectTier:
        for name in (NAME, OTHER):
            tier.put(name, DATA[1:])
        return ObjectTier(str(cache), limit_bytes=1 << 30)

    def read(name: bytes) -> Callable[[ObjectTier], object]:
        return lambda tier: tier.get(name, len(DATA))

    for one in interleaved(damaged, read(NAME), read(OTHER)):
        assert one.damaged_objects == 2


def test_what_two_threads_find_at_the_same_time_is_said_once(
    cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def say(tier: ObjectTier) -> None:
        tier._say(OSError(errno.ENOSPC, "no space"))

    for _ in interleaved(lambda: ObjectTier(str(cache), limit_bytes=1), say, say):
        assert caplog.text.count("objects not kept on disk") == 1
        caplog.clear()


# --- whose it is --------------------------------------------------------------------------------------


@contextmanager
def unused(tier: ObjectTier, caplog: pytest.LogCaptureFixture, why: str) -> Iterator[None]:
    """A tier with an object that is not used within, for that reason, which is logged once."""
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            assert tier.get(NAME, len(DATA)) is None
            assert not tier.put(NAME, DATA)
    assert caplog.text.count("objects not kept on disk") == 1
    assert why in caplog.text
    assert why in tier.problem
    yield


@pytest.mark.parametrize("mode", [0o770, 0o702, 0o1777, 0o2775])
def test_one_that_others_may_write_is_not_used(
    cache: Path, tier: ObjectTier, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    tier.put(NAME, DATA)
    (cache / "objects").chmod(mode)
    with unused(tier, caplog, f"may be written by other users (mode {mode:04o})"):
        (cache / "objects").chmod(0o750)
    assert tier.get(NAME, len(DATA)) == DATA, "put right while the daemon runs"
    assert tier.problem == ""


def test_one_that_is_a_link_is_not_used(
    cache: Path, tier: ObjectTier, caplog: pytest.LogCaptureFixture
) -> None:
    tier.put(NAME, DATA)
    (cache / "objects").rename(cache / "moved")
    (cache / "objects").symlink_to("moved")
    with unused(tier, caplog, "is a symbolic link"):
        pass
    assert path_of(cache).read_bytes() == DATA


@pytest.mark.root
@pytest.mark.parametrize("which", ["objects", "."])
def test_one_of_another_user_is_not_used(
    cache: Path, tier: ObjectTier, which: str, caplog: pytest.LogCaptureFixture
) -> None:
    tier.put(NAME, DATA)
    os.chown(cache / which, 12345, -1)
    with unused(tier, caplog, "belongs to user 12345, not to user 0"):
        os.chown(cache / which, 0, -1)
    assert tier.get(NAME, len(DATA)) == DATA


@pytest.mark.root
def test_root_makes_none_in_the_cache_of_a_service(cache: Path, tier: ObjectTier) -> None:
    """The service could not use it then."""
    cache.mkdir()
    os.chown(cache, 12345, -1)
    assert not tier.put(NAME, DATA)
    assert not list(cache.iterdir())


# --- beside a store -----------------------------------------------------------------------------------


class Origin:
    """A store in a directory, which counts what is read, and may be offline."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._store = DirectoryStore(str(directory))
        self.url = self._store.url
        self.is_offline = False
        self.asked: list[str] = []
        self._store.put(blob_path(NAME), DATA)
        self._store.put("CURRENT", b"{}")

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        if self.is_offline:
            raise Offline("the link is down")
        self.asked.append(path)
        return self._store.get_exactly(path, nbytes)


@pytest.fixture
def origin(tmp_path: Path) -> Origin:
    return Origin(tmp_path / "store")


@pytest.mark.parametrize("is_index", [False, True])
def test_fetched_once(origin: Origin, tier: ObjectTier, cache: Path, is_index: bool) -> None:
    objects = KeptObjects(origin, tier, is_index=is_index)
    assert objects.url == origin.url
    assert objects.read(NAME, len(DATA)) == DATA
    assert objects.read(NAME, len(DATA)) == DATA
    assert objects.get_exactly(blob_path(NAME), len(DATA)) == DATA
    assert origin.asked == [blob_path(NAME)]
    assert objects.counts == ObjectCounts(2, 2 * len(DATA), 1, len(DATA))
    origin.is_offline = True
    assert objects.read(NAME, len(DATA)) == DATA
    again = KeptObjects(origin, ObjectTier(str(cache), limit_bytes=1 << 30), is_index=is_index)
    assert again.read(NAME, len(DATA)) == DATA, "after a restart, by another instance"
    other = KeptObjects(origin, tier, is_index=not is_index)
    with pytest.raises(Offline):
        other.read(NAME, len(DATA))


def test_damaged_on_the_disk_is_fetched_again(origin: Origin, tier: ObjectTier, cache: Path) -> None:
    objects = KeptObjects(origin, tier)
    objects.read(NAME, len(DATA))
    flip(path_of(cache))
    assert objects.read(NAME, len(DATA)) == DATA
    assert path_of(cache).read_bytes() == DATA
    assert (len(origin.asked), tier.damaged_objects) == (2, 1)
    flip(path_of(cache))
    origin.is_offline = True
    with pytest.raises(Offline):
        objects.read(NAME, len(DATA))


def test_damaged_in_the_store_is_not_kept(origin: Origin, tier: ObjectTier, cache: Path) -> None:
    objects = KeptObjects(origin, tier)
    blob = origin.directory / blob_path(NAME)
    for data, why in ((DATA[::-1], "SHA-256 is not its name"), (DATA[:-1], "bytes")):
        blob.write_bytes(data)
        with pytest.raises(MapDataError, match=why):
            objects.read(NAME, len(DATA))
    blob.unlink()
    with pytest.raises(MapMissing):
        objects.read(NAME, len(DATA))
    assert not cache.exists()
    assert objects.counts == ObjectCounts(damaged_in_store=2, failed=3)


def test_what_has_no_hash_for_a_name_is_never_kept(origin: Origin, tier: ObjectTier, cache: Path) -> None:
    objects = KeptObjects(origin, tier)
    assert bytes(objects.get_exactly("CURRENT", 2)) == b"{}"
    for path in ("blobs/sha256/" + "A" * 64, blob_path(NAME) + "/..", "../" + blob_path(NAME)):
        with pytest.raises((MapMissing, MapDataError, Offline)):
            objects.get_exactly(path, 3)
    assert not cache.exists()


def test_without_a_tier_or_without_keeping(origin: Origin, tier: ObjectTier, cache: Path) -> None:
    for objects in (KeptObjects(origin, None), KeptObjects(origin, tier, keep=False)):
        assert objects.read(NAME, len(DATA)) == DATA
        assert not cache.exists()
    tier.put(NAME, DATA)
    objects = KeptObjects(origin, tier, keep=False)
    objects.read(NAME, len(DATA))
    assert objects.counts.disk_objects == 1


def test_many_threads(origin: Origin, cache: Path) -> None:
    """A budget for a third of it, pages among the cells: every read right, and never more than that kept."""
    random_ = random.Random(7)
    made: dict[bytes, bytes] = {}
    while len(made) < 60:
        data = random_.randbytes(random_.randrange(1, 4000))
        made[hashlib.sha256(data).digest()] = data
    for name, data in made.items():
        (origin.directory / blob_path(name)).write_bytes(data)
    tier = ObjectTier(str(cache), limit_bytes=20 * 4096)
    cells, pages = KeptObjects(origin, tier), KeptObjects(origin, tier, is_index=True)

    def read(name: bytes) -> None:
        objects = pages if name[0] % 4 == 0 else cells
        assert objects.read(name, len(made[name])) == made[name]

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(read, random_.choices(list(made), k=1500)))
    wait_for_trimming()
    total = sum(path.stat().st_blocks * 512 for path in cache.rglob("*") if path.is_file())
    assert 10 * 4096 < total <= 20 * 4096 * 17 / 16
    counts = [sum(both) for both in zip(cells.counts, pages.counts, strict=True)]
    assert counts[0] + counts[2] == 1500
    assert counts[0] > 300


def test_what_is_kept_while_the_directory_is_trimmed_is_trimmed_too(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tier = ObjectTier(str(cache), limit_bytes=100_000)
    trim = DiskBudget.trim
    random_ = random.Random(11)
    later = [random_.randbytes(5000) for _ in range(40)]

    def trim_then_keep(budget: DiskBudget) -> int:
        left_bytes = trim(budget)
        while later:
            data = later.pop()
            tier.put(hashlib.sha256(data).digest(), data)
        return left_bytes

    monkeypatch.setattr(DiskBudget, "trim", trim_then_keep)
    tier.put(NAME, DATA)
    wait_for_trimming()
    assert not later
    assert sum(path.stat().st_size for path in cache.rglob("*") if path.is_file()) <= 100_000


class Trimmer:
    """A thread that trims, which has begun or will begin."""

    def __init__(self, target: Callable[[], None] | None = None, **_options: object) -> None:
        self.target = target

    def start(self) -> None:
        """Wait: `target` is for the test to call."""

    def is_alive(self) -> bool:
        return True


def test_what_is_kept_as_the_trimming_ends_is_trimmed_too(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threading, "Thread", Trimmer)
    done: list[str] = []
    monkeypatch.setattr(DiskBudget, "trim", lambda _budget: done.append("trimmed"))

    def trimming() -> ObjectTier:
        tier = ObjectTier(str(cache), limit_bytes=1)
        tier._begin_to_trim()
        return tier

    def keep(tier: ObjectTier) -> None:
        before = tier._trimmer
        done.append("kept")
        tier._begin_to_trim()
        if tier._trimmer is not before:
            tier._trim()

    for first, second in ((ObjectTier._trim, keep), (keep, ObjectTier._trim)):
        for tier in interleaved(trimming, first, second):
            assert done[-1] == "trimmed"
            assert tier._trimmer is None
            done.clear()


def test_the_pages_of_the_version_in_use_stay(cache: Path) -> None:
    """Pages read long ago are marked as used when a version comes that has them too."""
    tier = ObjectTier(str(cache), limit_bytes=5 * 4 * 4096)
    pages = [random.Random(n).randbytes(4096) for n in range(8)]
    names = [hashlib.sha256(page).digest() for page in pages]
    for number, (name, page) in enumerate(zip(names, pages, strict=True)):
        tier.put(name, page, is_index=True)
        os.utime(path_of(cache, name, "index"), (0, DAY_S * number))
    tier.mark_index_used([names[0], names[1], bytes(32)])
    for number in range(40):
        data = random.Random(100 + number).randbytes(4000)
        tier.put(hashlib.sha256(data).digest(), data)
        wait_for_trimming()
    left = [tier.get(name, 4096, is_index=True) is not None for name in names]
    assert left == [True, True, False, False, False, True, True, True]


def test_reads_at_the_same_time_all_count(origin: Origin) -> None:
    def read(objects: KeptObjects) -> None:
        objects.read(NAME, len(DATA))

    for objects in interleaved(lambda: KeptObjects(origin, None), read, read):
        assert objects.counts == ObjectCounts(fetched_objects=2, fetched_bytes=2 * len(DATA))


def test_counts_are_those_that_the_statistics_have(origin: Origin, tier: ObjectTier, cache: Path) -> None:
    assert len(ObjectCounts._fields) == len(OBJECTS_READ)
    objects = KeptObjects(origin, tier)
    assert objects.read_kept(NAME, len(DATA)) is None
    objects.read(NAME, len(DATA))
    before = objects.counts
    path_of(cache).write_bytes(DATA[::-1])
    assert objects.read(NAME, len(DATA)) == DATA
    more = dict(zip(OBJECTS_READ, objects.counts.since(before), strict=True))
    assert {name: count for name, count in more.items() if count} == {
        "objects_fetched": 1, "bytes_fetched": len(DATA), "objects_damaged_on_disk": 1,
    }  # fmt: skip
    assert objects.read_kept(NAME, len(DATA)) is not None
