# SPDX-License-Identifier: Apache-2.0
"""Files of marks are whatever a mapper makes them: what is not one is refused, and nothing waits for it."""

from __future__ import annotations

import gc
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmmap.errors import BadRequest
from shmmap.live_worker.marks_directory import MAX_MARKS_BYTES, MarksDirectory
from tests.support.accounts import MEMBER
from tests.support.odd_files import ODD_FILES

SESSION = 0x1A
MINE = "1a.7"
CONTENT = b"marks of a scan"


@pytest.fixture
def path() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as directory:
        yield Path(directory) / "marks"


@pytest.fixture
def marks(path: Path) -> Iterator[MarksDirectory]:
    gc.collect()  # else what earlier tests left may be closed meanwhile
    before = len(os.listdir("/proc/self/fd"))
    one = MarksDirectory(str(path))
    yield one
    one.close()
    assert len(os.listdir("/proc/self/fd")) == before


def take(marks: MarksDirectory, name: str = MINE, nbytes: int = len(CONTENT)) -> bytes:
    return marks.take(name, nbytes, SESSION, os.geteuid())


def test_a_file_is_taken(marks: MarksDirectory, path: Path) -> None:
    (path / MINE).write_bytes(CONTENT)
    assert take(marks) == CONTENT
    assert not (path / MINE).exists(), "its memory is free for chunks"


OTHER_NAMES = [
    "1b.7",
    "a.7",
    "01a.7x",
    "1a.",
    "1a",
    "1A.7",
    "01a.7",
    "../1a.7",
    "1a.7/x",
    "1a.-1",
    "1a.7\n",
    "",
    ".",
]


@pytest.mark.parametrize(
    ("name", "nbytes", "said"),
    [
        *((name, len(CONTENT), "not a name that this session may use") for name in OTHER_NAMES),
        *((MINE, nbytes, "bytes") for nbytes in (0, -1, MAX_MARKS_BYTES + 1, 1 << 60)),
    ],
)
def test_names_and_sizes_that_cannot_be(
    marks: MarksDirectory, path: Path, name: str, nbytes: int, said: str
) -> None:
    for there in ("1b.7", MINE):
        (path / there).write_bytes(CONTENT)
    with pytest.raises(BadRequest, match=said):
        take(marks, name, nbytes)


def link(path: Path) -> None:
    other = path.with_name("1b.1")
    other.write_bytes(CONTENT)
    path.symlink_to(other)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (ODD_FILES["pipe"], "no regular file"),
        (ODD_FILES["directory"], "no regular file"),
        (link, "cannot be opened"),
        (lambda _path: None, "cannot be opened: No such file"),
        (lambda path: path.write_bytes(CONTENT[:-1]), "has 14 bytes, not 15"),
        (lambda path: path.write_bytes(CONTENT + b"x"), "has 16 bytes, not 15"),
    ],
)
def test_what_is_no_file_of_marks(
    marks: MarksDirectory, path: Path, make: Callable[[Path], object], said: str
) -> None:
    make(path / MINE)
    with pytest.raises(BadRequest, match=said):
        take(marks)


@pytest.mark.parametrize("length", [4, 1 << 30])
def test_one_that_is_changed_while_it_is_read(
    monkeypatch: pytest.MonkeyPatch, marks: MarksDirectory, path: Path, length: int
) -> None:
    (path / MINE).write_bytes(CONTENT)
    read = os.pread

    def change_and_read(fd: int, size: int, at: int) -> bytes:
        os.truncate(path / MINE, length)
        return read(fd, size, at)

    monkeypatch.setattr(os, "pread", change_and_read)
    if length > len(CONTENT):
        assert take(marks) == CONTENT
    else:
        with pytest.raises(BadRequest, match="was cut to 4 bytes"):
            take(marks)


@pytest.mark.root
def test_one_of_another_user(marks: MarksDirectory, path: Path) -> None:
    (path / MINE).write_bytes(CONTENT)
    os.chown(path / MINE, MEMBER, -1)
    with pytest.raises(BadRequest, match="no regular file of this user"):
        take(marks)
    assert marks.take(MINE, len(CONTENT), SESSION, MEMBER) == CONTENT


def test_who_may_put_files_there(path: Path) -> None:
    with_group = MarksDirectory(str(path), os.getegid())
    assert stat.S_IMODE(path.stat().st_mode) == 0o1770
    with_group.close()
    without = MarksDirectory(str(path))
    assert stat.S_IMODE(path.stat().st_mode) == 0o700
    without.close()
    assert not path.exists()


def test_what_an_previous_run_left_is_removed(path: Path) -> None:
    (path / "1a.9").mkdir(parents=True)
    (path / "2.2").write_bytes(CONTENT)
    one = MarksDirectory(str(path))
    assert list(path.iterdir()) == []
    one.close()


def test_the_files_of_a_session_go_with_it(marks: MarksDirectory, path: Path) -> None:
    for name in ("1a.1", "1a.2", "1.1", "1a1.1", "11a.1"):
        (path / name).write_bytes(CONTENT)
    (path / "1a.3").mkdir()
    os.mkfifo(path / "1a.4")
    (path / "1a.5").symlink_to("/etc/passwd")
    (path / "1a.6").mkdir()
    (path / "1a.6" / "x").touch()
    marks.on_disconnect(SESSION)
    left = sorted(name.name for name in path.iterdir())
    assert left == ["1.1", "11a.1", "1a.6", "1a1.1"], "a client's own files are its own to remove"
    (path / "1a.6" / "x").unlink()


@pytest.mark.root
def test_another_user_s_directory_is_not_used(path: Path) -> None:
    path.mkdir()
    os.chown(path, MEMBER, -1)
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(PermissionError, match="belongs to user"):
        MarksDirectory(str(path))
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_link_in_its_place_is_not_followed(path: Path, tmp_path: Path) -> None:
    (tmp_path / "keep").touch()
    path.symlink_to(tmp_path)
    with pytest.raises(OSError, match=r"is a symbolic link"):
        MarksDirectory(str(path))
    assert (tmp_path / "keep").exists()
    path.unlink()
