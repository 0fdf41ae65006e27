# SPDX-License-Identifier: Apache-2.0
"""A file is flushed to the disk before it gets its name, and the name before the file counts as written."""

from __future__ import annotations

import os
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


@pytest.mark.parametrize("replace", [True, False])
def test_a_file_that_appears(tmp_path: Path, steps: Steps, replace: bool) -> None:
    with appearing_file(tmp_path / "town.yaml", replace=replace) as file:
        file.write(b"x" * 3000)
    assert steps == [("bytes", 3000), ("name", "town.yaml"), ("names", tmp_path.name)]
