# SPDX-License-Identifier: Apache-2.0
"""What counts as a change of the map, when it is read again, and reading it beside the loop."""

from __future__ import annotations

import errno
import os
import select
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import FrameType

import pytest

from shmmap.daemon.host import inotify
from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.daemon.map.file_watch import MAX_DELAY_S, SETTLE_S, FileWatch, directories_of
from shmmap.errors import CannotStart, ShmmapError
from shmmap.origin.catalogue import Catalogue


@pytest.fixture
def watch(tmp_path: Path) -> Iterator[FileWatch]:
    one = FileWatch([str(tmp_path)])
    yield one
    one.close()


def test_the_directories_of_a_map(tmp_path: Path) -> None:
    """Of its cells, wherever those are, and of its metadata."""
    town, elsewhere = tmp_path / "town", tmp_path / "elsewhere"
    (town / "cells").mkdir(parents=True)
    assert directories_of(str(town), "", f"{town}/cells/") == {str(town), f"{town}/cells"}
    assert directories_of(str(town), "", f"{elsewhere}/") == {str(town)}, "it is not there"
    assert directories_of(str(town), f"{elsewhere}/map.yaml", f"{town}/") == {str(town), str(elsewhere)}
    assert directories_of(f"{town}/all.pcd", "", f"{town}/all.pcd") == {str(town)}
    assert directories_of("all.pcd", "", "") == {"."}


def test_it_is_due_once_the_files_were_left_alone(watch: FileWatch, tmp_path: Path) -> None:
    assert not watch.take_change(100.0)
    (tmp_path / "a.pcd").write_bytes(b"a")
    watch.drain(100.0)
    assert not watch.take_change(100.0 + SETTLE_S / 2)
    (tmp_path / "b.pcd").write_bytes(b"b")
    watch.drain(100.0 + SETTLE_S / 2)
    assert not watch.take_change(100.0 + SETTLE_S)
    assert watch.take_change(100.0 + 1.5 * SETTLE_S)
    assert not watch.take_change(200.0)  # once


def test_a_map_that_is_written_without_pause_is_read_all_the_same(watch: FileWatch, tmp_path: Path) -> None:
    now_s = 100.0
    while now_s < 100.0 + MAX_DELAY_S:
        (tmp_path / "a.pcd").write_bytes(b"a")
        watch.drain(now_s)
        assert not watch.take_change(now_s)
        now_s += SETTLE_S / 2
    assert watch.take_change(now_s)


CHANGES: dict[str, Callable[[Path], object]] = {
    "written": lambda at: (at / "a.pcd").write_bytes(b"b"),
    "renamed onto": lambda at: (at / "outside" / "n").rename(at / "a.pcd"),
    "renamed away": lambda at: (at / "a.pcd").rename(at / "outside" / "a.pcd"),
    "removed": lambda at: (at / "a.pcd").unlink(),
    "a directory made": lambda at: (at / "more").mkdir(),
    "a directory removed": lambda at: (at / "outside2").rmdir(),
}


@pytest.mark.parametrize("how", CHANGES)
def test_changes(tmp_path: Path, how: str) -> None:
    for name in ("outside", "outside2"):
        (tmp_path / name).mkdir()
    (tmp_path / "outside" / "n").write_bytes(b"n")
    (tmp_path / "a.pcd").write_bytes(b"a")
    with closing(FileWatch([str(tmp_path)])) as watch:
        CHANGES[how](tmp_path)
        watch.drain(1.0)
        assert watch.take_change(2.0)


def test_reading_is_no_change(watch: FileWatch, tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(b"a")
    watch.drain(1.0)
    assert watch.take_change(2.0)
    (tmp_path / "a.pcd").read_bytes()
    os.listdir(tmp_path)
    watch.drain(3.0)
    assert not watch.take_change(9.0)


def test_a_directory_that_may_not_be_watched_ends_nothing(watch: FileWatch, tmp_path: Path) -> None:
    """The metadata may name a place that is none: it is looked for again."""
    odd = tmp_path / "odd"
    odd.symlink_to(odd)
    watch.follow([str(odd)])
    assert not watch.take_change(1.0)
    odd.unlink()
    watch.drain(2.0)
    assert watch.take_change(3.0)
    odd.mkdir()
    watch.drain(4.0)
    assert watch.take_change(5.0)
    (odd / "a.pcd").write_bytes(b"a")
    watch.drain(6.0)
    assert watch.take_change(7.0)


def test_a_directory_that_is_replaced_is_followed(tmp_path: Path) -> None:
    """Moved away, it no longer counts; what takes its place does, however late it comes."""
    place, elsewhere = tmp_path / "map", tmp_path / "elsewhere"
    place.mkdir()
    watch = FileWatch([str(place)])
    place.rename(elsewhere)
    watch.drain(10.0)
    assert watch.take_change(11.0)
    (elsewhere / "a.pcd").write_bytes(b"a")
    watch.drain(12.0)
    assert not watch.take_change(13.0)
    place.mkdir()
    assert not watch.take_change(14.1), "it may be being filled"
    assert watch.take_change(14.1 + SETTLE_S)
    (place / "a.pcd").write_bytes(b"a")
    watch.drain(15.0)
    assert watch.take_change(16.0)
    watch.close()


def test_a_full_queue_counts_as_a_change(watch: FileWatch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inotify.Inotify, "read", lambda _: [inotify.Event(-1, inotify.OVERFLOW, "")])
    watch.drain(1.0)
    assert watch.take_change(2.0)


def test_a_limit_of_the_kernel_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ctypes.get_errno", lambda: errno.ENOSPC)

    class Full:
        """Has no watches left."""

        def inotify_init1(self, flags: int) -> int:
            return os.open("/dev/null", os.O_RDONLY | (flags & os.O_CLOEXEC))

        def inotify_add_watch(self, fd: int, path: bytes, mask: int) -> int:
            del fd, path, mask
            return -1

    monkeypatch.setattr(inotify, "_libc", Full())
    with pytest.raises(CannotStart, match="No space left") as raised:
        FileWatch([str(tmp_path)])
    assert "max_user_watches" in raised.value.hint


Result = Reread | ShmmapError


class Origin:
    """A map without cells."""

    path = "/maps/town"

    def load(self, *, fresh: bool = False, before: object | None = None) -> Catalogue:
        assert fresh
        assert before is not None
        return Catalogue.from_cells([])


@pytest.fixture
def reloader() -> Iterator[Reloader]:
    one = Reloader(Origin(), lambda: Catalogue.from_cells([]))
    yield one
    one.close()


def collect(reloader: Reloader) -> None:
    """Do what the loop does when the descriptor is readable."""
    assert select.select([reloader.fd], [], [], 30.0)[0]
    reloader.collect(lambda found: found, lambda _: None)


def test_a_request_meanwhile_gets_the_next_one(reloader: Reloader) -> None:
    answers: list[tuple[str, Result]] = []
    for name in "abc":
        reloader.ask(lambda result, name=name: answers.append((name, result)))  # type: ignore[misc]
    collect(reloader)
    assert [name for name, _ in answers] == ["a"]
    collect(reloader)
    assert [name for name, _ in answers] == ["a", "b", "c"]
    assert answers[1][1] is answers[2][1] is not answers[0][1]


def test_no_thread_is_to_be_had(reloader: Reloader, monkeypatch: pytest.MonkeyPatch) -> None:
    """That reload fails, and is answered; the next one works."""
    answers: list[Result] = []

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refuse)
        reloader.ask(answers.append)
    collect(reloader)
    assert isinstance(answers[0], ShmmapError)
    assert "can't start new thread" in answers[0].message
    reloader.ask(answers.append)
    collect(reloader)
    assert isinstance(answers[1], Reread)


def test_the_loop_does_not_wait_for_the_thread_to_end(reloader: Reloader) -> None:
    """A thread that has its result may still wait for a processor."""
    may_end, ended, answers = threading.Event(), list[bool](), list[Result]()

    def stay(frame: FrameType, event: str, _argument: object) -> None:
        if event == "return" and frame.f_code is Reloader._load.__code__:
            ended.append(may_end.wait(5.0))

    threading.setprofile(stay)
    try:
        reloader.ask(answers.append)
    finally:
        threading.setprofile(None)
    collect(reloader)
    assert len(answers) == 1
    assert not ended
    may_end.set()
