# SPDX-License-Identifier: Apache-2.0
"""A file is flushed to the disk before it gets its name, and the name before the file counts as written."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shmmap.formats.durable_file import appearing_file

Steps = list[tuple[str, object]]


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> Steps:
    """What is flushed and named from here on: a file by its size, a directory and a name by themselves."""
    taken: Steps = []

    def flushing(flush: Callable[[int], None]) -> Callable[[int], None]:
        def flushed(fd: int) -> None:
            flush(fd)
            path = Path(os.readlink(f"/proc/self/fd/{fd}"))
            taken.append(("names", path.name) if path.is_dir() else ("bytes", os.fstat(fd).st_size))

        return flushed

    def naming(name: Callable[..., None]) -> Callable[..., None]:
        def named(old: str, new: str | os.PathLike[str], **places: Any) -> None:
            name(old, new, **places)
            taken.append(("name", os.path.basename(new)))

        return named

    for call in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, call, flushing(getattr(os, call)))
    for call in ("replace", "link", "rename"):
        monkeypatch.setattr(os, call, naming(getattr(os, call)))
    return taken


@pytest.fixture(params=["without names", "with names"])
def disk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A file system whose files may be without names, as most, and one whose files may not, as NFS."""
    open_it = os.open

    def opened(path: str, flags: int, *rest: Any, **places: Any) -> int:
        if flags & os.O_TMPFILE == os.O_TMPFILE:
            raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP), path)
        return open_it(path, flags, *rest, **places)

    if request.param == "with names":
        monkeypatch.setattr(os, "open", opened)
    return str(request.param)


@pytest.mark.parametrize("replace", [True, False])
def test_a_file_that_appears(tmp_path: Path, disk: str, steps: Steps, replace: bool) -> None:
    with appearing_file(tmp_path / "town.yaml", replace=replace) as file:
        file.write(b"x" * 3000)
        assert len(list(tmp_path.iterdir())) == (disk == "with names")
    of_the_file = [one for one in steps if not str(one[1]).endswith(".tmp")]
    assert of_the_file == [("bytes", 3000), ("name", "town.yaml"), ("names", tmp_path.name)]
    assert [path.name for path in tmp_path.iterdir()] == ["town.yaml"]
    assert (tmp_path / "town.yaml").read_bytes() == b"x" * 3000


@pytest.mark.parametrize("replace", [True, False])
def test_a_file_of_that_name(
    tmp_path: Path, disk: str, monkeypatch: pytest.MonkeyPatch, replace: bool
) -> None:
    monkeypatch.chdir(tmp_path)  # a name alone
    Path("town.yaml").write_bytes(b"before")
    refused = contextlib.nullcontext() if replace else pytest.raises(FileExistsError)
    with refused, appearing_file("town.yaml", replace=replace) as file:
        file.write(b"after")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [
        ("town.yaml", b"after" if replace else b"before")
    ]


def test_a_kill_leaves_nothing(tmp_path: Path) -> None:
    program = (
        "import os, signal, sys\nfrom shmmap.formats.durable_file import appearing_file\n"
        "with appearing_file(sys.argv[1]) as file:\n"
        "    file.write(bytes(1 << 20))\n    os.kill(os.getpid(), signal.SIGKILL)"
    )
    ended = subprocess.run([sys.executable, "-c", program, str(tmp_path / "merged.pcd")])
    assert ended.returncode == -signal.SIGKILL
    assert list(tmp_path.iterdir()) == []
