# SPDX-License-Identifier: Apache-2.0
"""Kernels are compiled by one process at a time, and what is compiled is marked."""

from __future__ import annotations

import fcntl
from pathlib import Path

import pytest

from shmmap.layers import build

pytest.importorskip("numba", reason="needs the package numba")


@pytest.fixture
def mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "layers.compiled"
    monkeypatch.setattr(build, "compiled_mark", lambda: path)
    return path


def test_what_is_compiled_is_marked(mark: Path) -> None:
    build.compile_kernels()
    assert mark.exists()


def test_another_process_is_left_at_it(mark: Path) -> None:
    with mark.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        build.compile_kernels(wait=False)
    assert not mark.exists()


def test_where_nothing_can_be_kept_nothing_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "compiled_mark", lambda: None)
    build.compile_kernels()
    assert not list(tmp_path.iterdir())
