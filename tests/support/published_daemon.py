# SPDX-License-Identifier: Apache-2.0
"""What tests of published maps share: what they wait for, damage, and leave out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import shmmap
from tests.support import daemon_process
from tests.support.command_line import health
from tests.support.daemon_process import ROOT, DaemonProcess, Deadline, first_answer
from tests.support.web_servers import FaultyWeb

ALL = shmmap.Box(-1e6, -1e6, 1e6, 1e6)


def until(done: Callable[..., object], *values: object) -> None:
    """Wait until something is so of these values."""
    daemon_process.until(lambda: done(*values))


def until_health(one: DaemonProcess, code: int, says: str = "") -> str:
    """Wait until ``shmmap health --strict`` ends with a code and says something; returns what it prints."""
    return first_answer(lambda: health(one), lambda found: found[0] == code and says in found[1])[1]


def until_taken(one: DaemonProcess) -> None:
    """Wait until the daemon has written down the version that it has taken."""
    until(lambda: list(one.state_dir.rglob("*.taken")))


def all_cells(client: shmmap.Client) -> shmmap.CellSet:
    """Wait until a request for all cells is answered in full; returns them."""
    return first_answer(lambda: client.area(ALL, wait=5.0), lambda cells: cells.complete)


def versions_of(one: DaemonProcess) -> dict[str, int]:
    """Version of each cell of a daemon that can load all of them."""
    with shmmap.connect(one.endpoint) as client:
        cells = client.area(ALL, wait=60.0)
        assert cells.complete, cells.failed
        return {cell.id: cell.version for cell in cells}


def until_asked(web: FaultyWeb, path: str, times: int, status: int = 0) -> list[tuple[str, int]]:
    """Wait until a path was asked for that many times, with this answer; returns all requests."""
    asked: list[tuple[str, int]] = []
    waiting = Deadline()
    while waiting(sum(one == path and status in (0, code) for one, code in asked) < times):
        asked += web.requests()
    return asked


def flip(path: Path, at: int | None = None) -> bytes:
    """Change one bit of a file, by default in the middle; returns what it was."""
    whole = path.read_bytes()
    data = bytearray(whole)
    data[len(data) // 2 if at is None else at] ^= 1
    path.write_bytes(data)
    return whole


def without(package: str, folder: Path) -> dict[str, str]:
    """Environment in which a package is not installed."""
    hidden = folder / "without"
    hidden.mkdir()
    (hidden / f"{package}.py").write_text(f"raise ModuleNotFoundError('hidden', name={package!r})\n")
    return {"PYTHONPATH": f"{hidden}:{ROOT}"}
