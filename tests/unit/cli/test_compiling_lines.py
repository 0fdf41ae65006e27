# SPDX-License-Identifier: Apache-2.0
"""Lines on stderr while a verb waits for layers."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

import pytest

from shmmap.cli import compiling_lines


@dataclass
class Daemon:
    """Statistics of a daemon that computes a layer between two looks; the wait ends after some of them."""

    ended: threading.Event = field(default_factory=threading.Event)
    counters: dict[str, int] = field(default_factory=dict)
    compiling: int = 0
    computed: int = 5

    def __call__(self) -> Daemon:
        self.counters = {
            "loaders_compiling": self.compiling, "loads_finished": self.computed, "load_queue": 12,
            "layers_computed": self.computed, "workers": 1,
        }  # fmt: skip
        self.computed += 1
        if self.computed == 8:
            self.ended.set()
        return self


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_LOOK_S", "_LONG_S", "_PAUSE_S"):
        monkeypatch.setattr(compiling_lines, name, 0.0)


def test_who_waits_reads_how_far_the_daemon_is(capsys: pytest.CaptureFixture[str]) -> None:
    daemon = Daemon()
    compiling_lines._look(daemon, daemon.ended)  # type: ignore[arg-type]
    assert capsys.readouterr().err.splitlines() == [
        "shmmap: 0 loads done, 0 computed, 12 waiting for 1 loader",
        "shmmap: 1 load done, 1 computed, 12 waiting for 1 loader",
        "hint: `shmmap prepare` or the setting prepare computes layers ahead of time",
        "shmmap: 2 loads done, 2 computed, 12 waiting for 1 loader",
    ]


def test_kernels_are_said_once_and_instead(capsys: pytest.CaptureFixture[str]) -> None:
    daemon = Daemon(compiling=1)
    compiling_lines._look(daemon, daemon.ended)  # type: ignore[arg-type]
    assert capsys.readouterr().err.splitlines() == [
        "shmmap: the daemon compiles kernels for this layer, once for this version"
    ]
