# SPDX-License-Identifier: Apache-2.0
"""The client in C++ as tests use it: ``cpp_client.cpp`` as a process, behind the interface of Python's.

`CppClient` and `CppWindow` answer as `shmmap.Client` and `shmmap.MapWindow` do, so that one test drives both.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import msgspec
import numpy as np
import xxhash

import shmmap
from shmmap.errors import CellError
from shmmap.protocol import events
from tests.support.daemon_process import ROOT

INCLUDE: Final = ROOT / "clients" / "cpp" / "include"
SOURCE: Final = ROOT / "tests" / "support" / "cpp_client.cpp"
FLAGS: Final = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wpedantic", "-Werror", f"-I{INCLUDE}")


_CELL_WORDS: Final = 9


def compiled(folder: Path, *, compiler: str = "g++", standard: str = "c++17", optimize: str = "-Og") -> Path:
    """Compile the client with the sanitizers of addresses and of undefined behaviour."""
    program = folder / f"cpp_client.{compiler}.{standard}"
    subprocess.run(
        [
            compiler,
            f"-std={standard}",
            optimize,
            "-g1",
            "-fsanitize=address,undefined",
            "-fno-sanitize-recover=all",
            *FLAGS,
            str(SOURCE),
            "-o",
            str(program),
        ],
        check=True,
    )
    return program


def _kinds(root: type[shmmap.ShmmapError]) -> dict[str, type[shmmap.ShmmapError]]:
    found = {root.code: root}
    for kind in root.__subclasses__():
        found = _kinds(kind) | found
    return found


class CppProgram:
    """One such process, driven by lines of words."""

    def __init__(self, program: Path, environment: Mapping[str, str] = MappingProxyType({})) -> None:
        self.process = subprocess.Popen(
            [program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "ASAN_OPTIONS": "detect_leaks=1", **environment},
        )
        self._dropped: list[int] = []
        self._cells: weakref.WeakValueDictionary[int, CppCell] = weakref.WeakValueDictionary()

    def send(self, *words: object) -> None:
        """Say something; `answer` is to be called for it."""
        assert self.process.stdin is not None
        if self._dropped:
            dropped = self._dropped.copy()
            del self._dropped[: len(dropped)]  # in place: it is this list that cells append to
            self._write("drop", *dropped)
            self.answer()
        self._write(*words)

    def _write(self, *words: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write("\t".join("-" if word is None else str(word) for word in words) + "\n")
        self.process.stdin.flush()

    def answer(self) -> list[list[str]]:
        """Return the lines of the answer, each as its words."""
        assert self.process.stdout is not None
        found: list[list[str]] = []
        for line in self.process.stdout:
            if line == "end\n":
                return found
            found.append(line.removesuffix("\n").split("\t"))
        raise AssertionError(f"it ended with {self.process.wait()}")

    def ask(self, *words: object) -> list[list[str]]:
        """Say something, and return what it answers."""
        self.send(*words)
        return self.answer()

    def call(self, *words: object) -> list[list[str]]:
        """Say something; an error is raised as the client in Python does."""
        answer = self.ask(*words)
        if answer and answer[0][0] == "error":
            _, code, message = answer[0]
            raise _kinds(shmmap.ShmmapError).get(code, shmmap.ShmmapError)(message)
        return answer

    def cell(self, words: Sequence[str]) -> CppCell:
        """Return the cell of such a line: the same one as long as it is used."""
        number = int(words[1])
        cell = self._cells.get(number)
        if cell is None:
            cell = self._cells[number] = CppCell(self, words)
            weakref.finalize(cell, self._dropped.append, number)
        return cell

    @contextmanager
    def acting_at_stops(self, act: Callable[[], object], times: float) -> Iterator[None]:
        """Do something whenever it has stopped itself (``SHMMAP_TEST_STOP=STEP``), and have it go on."""
        pid, done = self.process.pid, 0

        def watch() -> None:
            nonlocal done
            while True:
                found = os.waitid(os.P_PID, pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
                if found is None or found.si_code != os.CLD_STOPPED:
                    return
                os.waitid(os.P_PID, pid, os.WSTOPPED)
                if done < times:
                    done += 1
                    act()
                os.kill(pid, signal.SIGCONT)

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            yield
        finally:
            assert self.process.stdin is not None
            self.process.stdin.close()  # it ends when it has nothing more to read
            thread.join()

    def close(self) -> int:
        """Have it end; returns its exit code: not 0 where a sanitizer found something."""
        with self.process:
            pass
        return self.process.returncode


class CppCell:
    """A cell that the process maps; its columns are asked for."""

    def __init__(self, program: CppProgram, words: Sequence[str]) -> None:
        _, number, self.id, self.layer, version, points, stale, self.frame_id, box = words
        self.box = tuple(map(float, box.split()))
        self._program, self.number = program, int(number)
        self.version, self.points, self.stale = int(version), int(points), stale == "1"

    def _column(self, name: str) -> tuple[np.ndarray, int]:
        ((dtype, shape, data, checksum),) = self._program.call("bytes", self.number, name)
        sides = tuple(map(int, shape.split()))
        return np.frombuffer(bytes.fromhex(data), dtype).reshape(sides), int(checksum)

    def __getitem__(self, name: str) -> np.ndarray:
        return self._column(name)[0]

    @property
    def xyz(self) -> np.ndarray:
        """The coordinates, (N, 3)."""
        return self["xyz"]

    def verify(self) -> None:
        """Compare the coordinates with the checksum that the header has of them."""
        values, checksum = self._column("xyz")
        assert xxhash.xxh3_64_intdigest(values.tobytes()) == checksum


class _Answer:
    """What of `shmmap.CellSet` and `shmmap.WindowUpdate` is the same: what is missing."""

    def __init__(self, program: CppProgram, lines: list[list[str]]) -> None:
        self._lines = lines
        self._program = program
        self._cells = {line[1]: program.cell(line) for line in lines if len(line) == _CELL_WORDS}

    def of(self, *roles: str) -> tuple[CppCell, ...]:
        """Cells that the answer names so."""
        return tuple(
            self._cells[line[1]] for line in self._lines if line[0] in roles and len(line) == _CELL_WORDS
        )

    def words(self, kind: str) -> list[str]:
        """The one line of this kind."""
        (line,) = (line for line in self._lines if line[0] == kind)
        return line[1:]

    @cached_property
    def pending(self) -> tuple[shmmap.PendingLayer, ...]:
        """Cells that are being loaded."""
        return tuple(shmmap.PendingLayer(*line[1:]) for line in self._lines if line[0] == "pending")

    @cached_property
    def failed(self) -> tuple[CellError, ...]:
        """Cells that cannot be had."""
        kinds = _kinds(CellError)
        found = []
        for _, cell_id, layer, code, message in (line for line in self._lines if line[0] == "failed"):
            kind = kinds.get(code, CellError)
            assert issubclass(kind, CellError)
            found.append(kind(f"{cell_id} ({layer}): {message}", cell_id=cell_id, layer=layer))
        return tuple(found)

    @cached_property
    def removed(self) -> tuple[str, ...]:
        """Ids that left."""
        return tuple(line[1] for line in self._lines if line[0] == "removed")


class CppCells(_Answer):
    """As `shmmap.CellSet`."""

    def __init__(self, program: CppProgram, lines: list[list[str]]) -> None:
        super().__init__(program, lines)
        self.cells = self.of("cell")
        epoch, map_version, covered, self.reason = self.words("answer")
        self.epoch, self.map_version, self.covered = int(epoch), int(map_version), covered == "1"
        self.removed_versions = {int(line[1]) for line in lines if line[0] == "removed_version"}

    @property
    def complete(self) -> bool:
        """Whether nothing that was asked for is missing."""
        return self.covered and not self.failed and not self.pending

    def raise_for_failures(self) -> CppCells:
        """Return the answer, or raise the first of `failed`."""
        if self.failed:
            raise self.failed[0]
        return self

    def __len__(self) -> int:
        return len(self.cells)

    def __iter__(self) -> Iterator[CppCell]:
        return iter(self.cells)

    def __getitem__(self, index: int) -> CppCell:
        return self.cells[index]


class CppUpdate(_Answer):
    """As `shmmap.WindowUpdate`."""

    def __init__(self, program: CppProgram, lines: list[list[str]]) -> None:
        super().__init__(program, lines)
        self.added, self.kept, self.changed = self.of("added"), self.of("kept"), self.of("changed")
        self.current, self.covered, self.complete = (word == "1" for word in self.words("update"))

    @property
    def any(self) -> bool:
        """Whether the set of cells is another one than before."""
        return bool(self.added or self.changed or self.removed)


def _area(area: shmmap.Circle | shmmap.AutowareSquare | shmmap.Box) -> str:
    if isinstance(area, shmmap.Box):
        return _words("box", *area.bounds)
    kind = "circle" if isinstance(area, shmmap.Circle) else "square"
    heights = area.z or ()
    return _words(kind, area.x, area.y, area.radius, *heights)


def _words(kind: str, *numbers: float) -> str:
    return " ".join([kind, *(repr(float(number)) for number in numbers)])


def _texts(texts: str | Iterable[str]) -> str:
    return texts if isinstance(texts, str) else ";".join(texts)


class CppClient:
    """As `shmmap.Client`, what there is of it in C++.

    Parameters
    ----------
    program
        As `compiled` returns it.
    timeout
        Seconds that an answer may take, beyond what the daemon waits for loads.
    """

    def __init__(
        self,
        program: Path,
        endpoint: str,
        *,
        name: str = "cpp",
        timeout: float = 5.0,
        connect_timeout: float = 1.0,  # noqa: ARG002  it has one of its own
        environment: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.program = CppProgram(program, environment)
        try:
            ((_, session, epoch),) = self.program.call("connect", endpoint, name, timeout)
        except shmmap.ShmmapError:
            self.program.close()
            raise
        self.slot, self.epoch, self.map_version = int(session), int(epoch), 0

    def __enter__(self) -> CppClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End it; nothing in it may have leaked or gone wrong."""
        assert self.program.close() == 0

    def _cells(self, *words: object) -> CppCells:
        found = CppCells(self.program, self.program.call(*words))
        self.epoch, self.map_version = found.epoch, found.map_version
        return found

    def area(self, area: Any, layers: Any = "points", wait: float | None = 5.0) -> CppCells:
        """As `shmmap.Client.area`."""
        return self._cells("area", _area(area), _texts(layers), wait)

    def around(
        self,
        x: float,
        y: float,
        radius: float,
        layers: Any = "points",
        wait: float | None = 5.0,
        z: Any = None,
    ) -> CppCells:
        """As `shmmap.Client.around`."""
        circle = shmmap.Circle(float(x), float(y), float(radius), z)
        return self.area(circle, layers, wait)

    def differential(
        self,
        area: Any,
        held: Iterable[CppCell | str | tuple[str, int]],
        layers: Any = "points",
        wait: float | None = 5.0,
        by_name: bool = False,
    ) -> CppCells:
        """As `shmmap.Client.differential`; what is held by cells are all that are used here."""
        some: Collection[CppCell | str | tuple[str, int]] = list(held)
        named = []
        for one in some:
            if isinstance(one, CppCell):
                named += [f"{one.id};{one.version};{one.layer}"] if by_name else []
            else:
                named.append(one if isinstance(one, str) else f"{one[0]};{one[1]}")
        found = self._cells("differential", _area(area), _texts(layers), wait, *named)
        if not named:
            gone = [
                one.id for one in some if isinstance(one, CppCell) and one.version in found.removed_versions
            ]
            found.removed = tuple(gone)
        return found

    def selected(
        self, ids: str | Iterable[str], layers: Any = "points", wait: float | None = 5.0
    ) -> CppCells:
        """As `shmmap.Client.selected`."""
        return self._cells("selected", _texts(ids), _texts(layers), wait)

    def release(self) -> None:
        """As `shmmap.Client.release`."""
        self.program.call("release")

    def columns(self) -> list[list[str]]:
        """Return every column of every cell that is used here, with a CRC-32 of its bytes."""
        return self.program.call("columns")


class CppNear(_Answer):
    """As `shmmap.PointsAround`."""

    def __init__(self, program: CppProgram, lines: list[list[str]]) -> None:
        super().__init__(program, lines)
        self.cells = self.of("whole", "part")
        self.whole = tuple(line[0] == "whole" for line in lines if len(line) == _CELL_WORDS)
        covered, count = self.words("around")
        self.covered, self._count = covered == "1", int(count)

    def __len__(self) -> int:
        return len(self.cells)

    def count(self) -> int:
        """How many points lie in the circle."""
        return self._count


class CppWindow:
    """As `shmmap.MapWindow` without a thread."""

    def __init__(
        self,
        program: Path,
        endpoint: str,
        radius: float = 150.0,
        *,
        layers: Any = "points",
        shape: str = "circle",
        update_distance: float = 20.0,
        refresh_interval: float = 1.0,
        retention: shmmap.Retention | None = None,
        z: tuple[float, float] | None = None,
        timeout: float = 5.0,
        name: str = "window",
    ) -> None:
        self.client = CppClient(program, endpoint, name=name, timeout=timeout)
        self._program = self.client.program
        keep = retention if retention is not None else shmmap.Retention()
        self._program.call(
            "window",
            radius,
            _texts(layers),
            shape,
            update_distance,
            refresh_interval,
            keep.distance,
            keep.max_bytes,
            keep.max_age,
            *(z or ()),
        )

    def __enter__(self) -> CppWindow:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End it; nothing in it may have leaked or gone wrong."""
        self.client.close()

    def move_to(
        self,
        x: float,
        y: float,
        *,
        vx: float = 0.0,
        vy: float = 0.0,
        heading: float | None = None,
        route: Iterable[tuple[float, float]] = (),
        wait: float | None = None,
    ) -> CppUpdate:
        """As `shmmap.MapWindow.move_to`."""
        path = [f"{route_x} {route_y}" for route_x, route_y in route]
        return CppUpdate(self._program, self._program.call("move", x, y, vx, vy, heading, wait, *path))

    def _state(self) -> tuple[list[str], tuple[CppCell, ...]]:
        lines = self._program.call("state")
        return lines[0][1:], tuple(self._program.cell(line) for line in lines[1:])

    @property
    def cells(self) -> tuple[CppCell, ...]:
        """Cells in the window, in id order."""
        return self._state()[1]

    @property
    def complete(self) -> bool:
        """Whether the window answers the last pose, and nothing in it is missing."""
        return self._state()[0][0] == "1"

    @property
    def error(self) -> shmmap.ShmmapError | None:
        """Why the daemon cannot be asked."""
        code = self._state()[0][1]
        return None if code == "-" else _kinds(shmmap.ShmmapError)[code]("")

    @property
    def stale_since(self) -> float | None:
        """Whether the daemon cannot be asked, as 0.0: when, is on a clock of the process."""
        return 0.0 if self._state()[0][2] == "1" else None

    @property
    def map_version(self) -> int:
        """State of the map the window shows."""
        return int(self._state()[0][3])

    def wait_until_current(self, timeout: float) -> bool:  # noqa: ARG002
        """Whether it is so: as a window without a thread."""
        return self.complete and self.error is None

    def covers(self, x: float, y: float, radius: float = 0.0) -> bool:
        """As `shmmap.MapWindow.covers`."""
        return self._program.call("covers", x, y, radius) == [["covers", "1"]]

    def points_around(self, x: float, y: float, radius: float, *, layer: str = "") -> CppNear:
        """As `shmmap.MapWindow.points_around`."""
        return CppNear(self._program, self._program.call("around", x, y, radius, layer, "count"))


class CppEventStream:
    """As `shmmap.events.EventStream`."""

    def __init__(
        self,
        program: Path,
        endpoint: str,
        *,
        since: float | None = None,
        timeout: float = 5.0,  # noqa: ARG002
    ) -> None:
        self._program = CppProgram(program)
        self._program.call("events", endpoint, since)

    def close(self) -> None:
        """End it; nothing in it may have leaked or gone wrong."""
        assert self._program.close() == 0

    @property
    def epoch(self) -> int:
        """Number of the daemon's run."""
        return int(self._program.call("epoch")[0][1])

    def next(self, timeout: float | None = None) -> events.Event | shmmap.events.MissedEvents | None:
        """As `shmmap.events.EventStream.next`."""
        lines = self._program.call("next", 1e6 if timeout is None else timeout)
        if not lines:
            return None
        what, *words = lines[0]
        if what == "missed":
            return shmmap.events.MissedEvents(*map(int, words))
        named = words[:4] + [word.partition("=")[2] for word in words[4:]]
        found: events.Event = msgspec.convert(named, events.Event, strict=False)
        return found


class CppFollower:
    """As `tests.support.client_programs.FollowingClient`: it is sent poses, and says what it sees."""

    def __init__(self, program: Path, endpoint: str, mode: str) -> None:
        self._mode = mode
        self._client = CppClient(program, endpoint, name=f"c++ {mode}", timeout=60.0)
        self._program = self._client.program
        self._held: dict[str, CppCell] = {}
        self._has_window = False

    def ask(self, x: float, y: float, radius: float) -> None:
        """Send a pose."""
        if self._mode == "window":
            if not self._has_window:
                self._program.call("window", radius, "points", "circle", 0.0, 1.0, 0.0, np.inf, np.inf)
                self._has_window = True
            self._program.send("move", x, y, 0.0, 0.0, None, 60.0)
        else:
            self._program.send("differential", _words("circle", x, y, radius), "points", 60.0)

    def answer(self) -> dict[str, Any]:
        """Return what it saw there."""
        lines = self._program.answer()
        if self._mode == "window":
            update = CppUpdate(self._program, lines)
            assert update.complete, lines
            new, removed = [*update.added, *update.changed], list(update.removed)
            self._held = {cell.id: cell for cell in (*update.kept, *new)}
        else:
            reply = CppCells(self._program, lines)
            assert reply.complete, lines
            new = list(reply.cells)
            removed = [cell.id for cell in self._held.values() if cell.version in reply.removed_versions]
            for cell_id in removed:
                del self._held[cell_id]
            self._held |= {cell.id: cell for cell in new}
        versions = {cell.id: cell.version for cell in new}
        rows = [[cell_id, versions[cell_id], *content] for cell_id, *content in self._contents(new)]
        return {"new": rows, "removed": removed, "held": [[c.id, c.version] for c in self._held.values()]}

    def contents(self) -> list[list[Any]]:
        """Return the id, points and CRC-32 of xyz and of the intensity of every cell it holds."""
        return self._contents(self._held.values())

    def _contents(self, cells: Collection[CppCell]) -> list[list[Any]]:
        if not cells:
            return []
        lines = self._program.call("columns", *(cell.number for cell in cells))
        crc = {(line[0], line[2]): int(line[6]) for line in lines}
        return [[cell.id, cell.points, crc[cell.id, "xyz"], crc[cell.id, "intensity"]] for cell in cells]

    def kill(self) -> None:
        """End it now, whatever it does."""
        self._program.process.kill()
        self._program.process.communicate()
