# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels on disk: damaged ones are compiled again, and only trusted ones are run."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import importlib.util
import logging
import os
import pickle
import resource
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from shmmap import compile_notices, kernel_cache
from shmmap.cli.compiling_lines import CompilingLines
from shmmap.layers import build

pytest.importorskip("numba", reason="needs the package numba")

SOURCE = """
from numba import types
from shmmap.compiling import compiled

@compiled(types.int64(types.int64))
def doubled(value):
    return 2 * value
"""


class Kernel:
    """A module with a kernel, imported as by another process each time."""

    def __init__(self, folder: Path, directory: Path) -> None:
        self.module = folder / "doubling.py"
        self.module.write_text(SOURCE)
        self.directory = directory

    def hits(self) -> int:
        """Import it and compute; returns how many variants came from the disk."""
        spec = importlib.util.spec_from_file_location("doubling", self.module)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        assert module.doubled(21) == 42
        return sum(module.doubled.stats.cache_hits.values())

    @property
    def file(self) -> Path:
        """The one file of the kernel."""
        (found,) = self.directory.glob("*.kernel")
        return found


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Kernel]:
    directory = tmp_path / "kernels"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(directory))
    monkeypatch.setattr(kernel_cache, "_said", set())
    monkeypatch.setattr(kernel_cache, "_unkept", [])
    yield Kernel(tmp_path, directory)
    for path in (directory, *directory.glob("*")) if directory.is_dir() else ():
        path.chmod(0o700)


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def test_what_is_compiled_is_kept(kernel: Kernel, caplog: pytest.LogCaptureFixture) -> None:
    assert [kernel.hits(), kernel.hits(), kernel.hits()] == [0, 1, 1]
    assert stat.S_IMODE(kernel.directory.stat().st_mode) == 0o700
    assert kernel_cache.all_kept()
    assert not warnings(caplog)


def test_compiling_is_noticed_and_loading_is_not(
    kernel: Kernel, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A program's lines: one at first, with how far it is; the next one seconds later."""
    seen: list[tuple[str, int, int]] = []
    lines = CompilingLines("shmmap-ndt")

    def show(*notice: Any) -> None:
        seen.append(notice)
        lines(f"shmmap.{notice[0]}", *notice[1:])

    monkeypatch.setattr(compile_notices, "_watchers", [])
    compile_notices.watch(show)
    two_types = "compiled(types.int64(types.int64), types.float64(types.float64))"
    again = SOURCE.partition("\n\n")[2].replace("doubled", "again")
    kernel.module.write_text(SOURCE.replace("compiled(types.int64(types.int64))", two_types) + again)
    assert [kernel.hits(), kernel.hits()] == [0, 2]
    assert seen == [("doubling", 1, 2), ("doubling", 2, 2)], "a kernel once, for all its types"
    assert capsys.readouterr().err == (
        "shmmap-ndt: compiling kernels, once for this version: doubling, 1 of 2\n"
    )


def test_the_first_is_logged(
    kernel: Kernel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(compile_notices, "_logged", [])
    monkeypatch.setattr(compile_notices, "_watchers", [compile_notices.log_first])
    with caplog.at_level(logging.INFO, "shmmap"):
        kernel.hits()
        kernel.module.write_text(SOURCE.replace("2 * value", "value + value"))
        kernel.hits()
    assert caplog.messages == ["compiling kernels, once for this version module=doubling kernels=1"]


def test_another_source_is_another_kernel(kernel: Kernel, caplog: pytest.LogCaptureFixture) -> None:
    kernel.hits()
    kernel.module.write_text(SOURCE.replace("2 * value", "value + value"))
    assert [kernel.hits(), kernel.hits()] == [0, 1]
    assert kernel.file  # in place of the other
    assert not warnings(caplog)


# --- damage ----------------------------------------------------------------------------------------


def flip(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def a_link(path: Path) -> None:
    path.rename(path.with_suffix(".elsewhere"))
    path.symlink_to(path.with_suffix(".elsewhere"))


def a_loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)


def give_payload(path: Path, payload: bytes) -> None:
    """Replace the kernel; its file is as good as before."""
    head = path.read_bytes()[:40]
    path.write_bytes(head + hashlib.sha256(payload).digest() + payload)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "shortened": lambda path: os.truncate(path, path.stat().st_size // 2),
    "another magic": lambda path: flip(path, 0),
    "of another version": lambda path: flip(path, 20),
    "another hash": lambda path: flip(path, 50),
    "another kernel": lambda path: flip(path, -1),
    "zeros, as a power cut leaves them": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "enlarged": lambda path: os.truncate(path, 1 << 40),
    "a pipe": a_pipe,
    "a link": a_link,
    "a loop": a_loop,
    "unreadable": lambda path: path.chmod(0),
    "no pickle": lambda path: give_payload(path, b"no pickle"),
    "of a module that is gone": lambda path: give_payload(path, b"cnumba.gone\nName\n."),
    "of something else": lambda path: give_payload(path, pickle.dumps(("a", 1))),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_kernel_is_compiled_and_replaced(
    kernel: Kernel, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    kernel.hits()
    (mark := kernel_cache.compiled_mark() or Path()).touch()
    DAMAGES[what](file := kernel.file)
    if what == "unreadable" and os.geteuid() == 0:
        assert kernel.hits() == 1
        return
    assert [kernel.hits(), kernel.hits()] == [0, 1]
    if what == "of another version":
        return  # nothing is logged
    assert not mark.exists()  # the next daemon looks after all of them
    (line,) = warnings(caplog)
    assert line.startswith(f"compiled kernel discarded path={file} reason=")


def test_damage_is_logged_once(kernel: Kernel, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(3):
        kernel.hits()
        kernel.file.write_bytes(b"")
    assert len(warnings(caplog)) == 1


def test_a_directory_where_a_kernel_should_be_stays(kernel: Kernel, caplog: pytest.LogCaptureFixture) -> None:
    kernel.hits()
    path = kernel.file
    path.unlink()
    (path / "a user's").mkdir(parents=True)
    assert [kernel.hits(), kernel.hits()] == [0, 0]
    assert str(path) in warnings(caplog)[0]
    (path / "a user's").rmdir()
    path.rmdir()
    assert [kernel.hits(), kernel.hits()] == [0, 1]


# --- nowhere to keep them --------------------------------------------------------------------------


def a_file(directory: Path) -> Callable[[], object]:
    directory.write_text("")
    return directory.unlink


def below_a_file(directory: Path) -> Callable[[], object]:
    os.environ["NUMBA_CACHE_DIR"] = str(directory / "below")
    return a_file(directory)


def a_link_to_nothing(directory: Path) -> Callable[[], object]:
    directory.symlink_to("nothing")
    return directory.unlink


def written_by_others(directory: Path) -> Callable[[], object]:
    directory.mkdir()
    directory.chmod(0o777)
    return lambda: directory.chmod(0o700)


def read_only(directory: Path) -> Callable[[], object]:
    directory.mkdir()
    directory.chmod(0o500)
    return lambda: directory.chmod(0o700)


@pytest.mark.parametrize(
    "obstacle",
    [a_file, below_a_file, a_link_to_nothing, written_by_others, read_only],
    ids=lambda obstacle: obstacle.__name__,
)
def test_where_none_can_be_kept_each_process_compiles(
    kernel: Kernel, obstacle: Callable[[Path], Callable[[], object]], caplog: pytest.LogCaptureFixture
) -> None:
    remove = obstacle(kernel.directory)
    if obstacle is read_only and os.geteuid() == 0:
        return  # which does not stop root
    assert [kernel.hits(), kernel.hits()] == [0, 0]
    (line,) = warnings(caplog)
    assert line.startswith(f"compiled kernels are not kept path={kernel.directory}")
    assert kernel_cache.compiled_mark() is None
    remove()
    assert [kernel.hits(), kernel.hits()] == [0, 1]  # back by itself


def test_without_a_home(monkeypatch: pytest.MonkeyPatch, kernel: Kernel) -> None:
    for name in ("NUMBA_CACHE_DIR", "CACHE_DIRECTORY", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert kernel.hits() == 0
    assert kernel_cache.kernel_directory() is None


def test_a_file_too_large_for_a_limit(kernel: Kernel) -> None:
    """As on a full disk: the file is begun, and cannot be finished; which is tried again."""
    program = "import doubling; print(doubling.doubled(21), sum(doubling.doubled.stats.cache_hits.values()))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=kernel.module.parent,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(["", *sys.path])},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024)),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == "42 0\n"
    assert done.stderr.count("compiled kernels are not kept") == 1
    assert os.strerror(errno.EFBIG) in done.stderr
    assert not list(kernel.directory.iterdir())
    assert [kernel.hits(), kernel.hits()] == [0, 1]


def test_what_was_left_unfinished_is_removed(kernel: Kernel) -> None:
    kernel.hits()
    left, begun = kernel.directory / "a.kernel.12.tmp", kernel.directory / "b.kernel.34.tmp"
    left.write_bytes(b"half")
    os.utime(left, (0, 0))
    begun.write_bytes(b"half")
    assert kernel_cache.all_kept()
    assert (left.exists(), begun.exists()) == (False, True)


# --- whose they are --------------------------------------------------------------------------------


def give_away(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a file or directory another user's."""
    if os.geteuid() == 0:
        os.chown(path, 65534, 65534)
    else:
        real = os.fstat
        others = (path.stat().st_dev, path.stat().st_ino)

        def fstat(fd: int) -> Any:
            found = real(fd)
            if (found.st_dev, found.st_ino) != others:
                return found
            return os.stat_result([*found[:4], found.st_uid + 1, *found[5:]])

        monkeypatch.setattr(os, "fstat", fstat)


class Harm:
    """What runs a program of its own when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("mode", [0o600, 0o620, 0o602, 0o666])
@pytest.mark.parametrize("others", [False, True])
def test_a_file_that_others_may_have_written_is_not_run(
    kernel: Kernel, tmp_path: Path, mode: int, others: bool, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    kernel.hits()
    path = kernel.file
    give_payload(path, pickle.dumps(Harm(tmp_path / "harm")))
    path.chmod(mode)
    if others:
        give_away(path, monkeypatch)
    trusted = mode == 0o600 and not others
    assert kernel.hits() == 0
    assert (tmp_path / "harm").exists() == trusted  # else it was not even unpickled
    monkeypatch.undo()
    (line,) = warnings(caplog)
    assert trusted or "belongs to user" in line or f"chmod go-w {path}" in line


@pytest.mark.parametrize(("mode", "others"), [(0o770, False), (0o1777, False), (0o707, False), (0o700, True)])
def test_a_directory_where_others_may_write_is_not_used(
    kernel: Kernel, mode: int, others: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    kernel.hits()
    kernel.directory.chmod(mode)
    if others:
        give_away(kernel.directory, monkeypatch)
    before = kernel.file.stat()
    assert kernel.hits() == 0
    assert kernel.file.stat() == before
    (line,) = warnings(caplog)
    assert "belongs to user" in line or f"chmod go-w {kernel.directory}" in line


def test_a_link_to_the_directory_is_followed(kernel: Kernel, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    kernel.directory.symlink_to(tmp_path / "elsewhere")
    assert [kernel.hits(), kernel.hits()] == [0, 1]


def test_kernels_that_came_with_an_image_are_used(
    kernel: Kernel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Where they cannot be written they can be read."""
    kernel.hits()
    kernel.directory.chmod(0o500)
    assert kernel.hits() == 1
    assert not warnings(caplog)


# --- kernels are compiled by one process at a time, and what is compiled is marked ------------------------


@pytest.fixture
def mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "layers.compiled"
    monkeypatch.setattr(build, "compiled_mark", lambda: path)
    return path


def test_what_is_compiled_is_marked_by_one_process_at_a_time(mark: Path) -> None:
    with mark.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        build.compile_kernels(wait=False)
        assert not mark.exists()
    build.compile_kernels()
    assert mark.exists()


def test_where_nothing_can_be_kept_nothing_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "compiled_mark", lambda: None)
    build.compile_kernels()
    assert not list(tmp_path.iterdir())
