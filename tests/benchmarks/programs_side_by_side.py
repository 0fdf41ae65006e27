# SPDX-License-Identifier: Apache-2.0
"""Localization, the compare filter and the elevation map side by side on one daemon, over a drive.

Each is the real program in a process of its own.  Scans go to the first two over ZeroMQ; a few at a time
are in flight, never more than both can take, so that a scan that is missing in the end was lost.  The
third keeps reading the whole map.  Nothing here waits for a time to pass.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.scan_stream import ScanPublisher, decode_scan
from shmmap_clients.scans.trajectory import tum_line

from shmmap.demo.program import Program
from shmmap.errors import InternalError

_IN_FLIGHT: Final = 6  # scans
_ANSWER_S: Final = 120.0  # for an answer
_LAST_RUN_S: Final = 900.0  # for a program's end: the elevation map may just have begun a large map
_POLL_MS: Final = 1000


class ProgramRun(Program):
    """One of the programs, and what was seen of it.

    Attributes
    ----------
    document
        What it printed at its end, its ``--json``.
    runs
        How often it ran to its end.
    own_bytes
        Anonymous memory at every sample of the drive (RssAnon).
    shared_bytes
        Shared memory that it had mapped and touched, at most (RssShmem).
    """

    def __init__(self, name: str, module: str, words: list[str], work: Path) -> None:
        super().__init__(name, module, words, work)
        self.document: dict[str, Any] = {}
        self.runs = 0
        self.own_bytes: list[int] = []
        self.shared_bytes = 0

    def sample(self) -> None:
        """Look at its memory."""
        try:
            status = Path(f"/proc/{self.pid}/status").read_text(encoding="utf-8")
        except OSError:
            return
        found = dict(re.findall(r"^(RssAnon|RssShmem):\s+(\d+) kB$", status, re.MULTILINE))
        if "RssAnon" in found:  # not in one that has just ended
            self.own_bytes.append(int(found["RssAnon"]) << 10)
            self.shared_bytes = max(self.shared_bytes, int(found["RssShmem"]) << 10)

    def complete(self) -> None:
        """Wait for its end and read the document that it printed."""
        printed = self.finish(_LAST_RUN_S, fails=True)
        if not printed:
            raise InternalError(f"{self.name} printed nothing: {self.last_words()}")
        self.document = json.loads(printed)
        self.runs += 1

    @property
    def growth_bytes(self) -> int:
        """How much more it had at most in the last third than in the middle one."""
        third = len(self.own_bytes) // 3
        if not third:
            return 0
        return max(self.own_bytes[2 * third :]) - max(self.own_bytes[third : 2 * third])


@dataclass(slots=True)
class ThreePrograms:
    """What came of it.

    Attributes
    ----------
    scans, seconds
        Scans sent, and how long it took.
    acknowledged
        Scans that came back from ``ndt`` and from ``compare``.
    segment_bytes
        Shared memory of the daemon at every sample.
    segments_seen
        Segments that were there at one time or another: how much came and went.
    programs
        By name.
    """

    scans: int = 0
    seconds: float = 0.0
    acknowledged: dict[str, int] = field(default_factory=dict)
    segment_bytes: list[int] = field(default_factory=list)
    segments_seen: set[str] = field(default_factory=set)
    programs: dict[str, ProgramRun] = field(default_factory=dict)


def run_three_programs(
    endpoint: str,
    shm_dir: str,
    instance: str,
    scans: Iterable[Scan],
    odometry: Iterable[tuple[float, NDArray[np.float64]]],
    work: Path,
    *,
    ndt: Iterable[str] = (),
    compare: Iterable[str] = (),
    elevation: Iterable[str] = (),
) -> ThreePrograms:
    """Run them until the scans end, then until each has ended.

    Parameters
    ----------
    endpoint, shm_dir, instance
        The daemon's.
    scans
        With poses and names of their own.
    odometry
        For the localization: time and pose of every scan to come, in any frame.
    work
        Directory for sockets, caches and outputs; ``ndt.svg`` and ``compare.svg`` are the drives' pictures.
    ndt, compare, elevation
        More words for each program's command line.

    Raises
    ------
    InternalError
        A program ended before its time, or did not answer.
    """
    odometry_file = work / "odometry.txt"
    odometry_file.write_text("\n".join(tum_line(stamp, T) for stamp, T in odometry) + "\n", encoding="utf-8")
    result = ThreePrograms()
    address = {name: f"ipc://{work}/{name}" for name in ("to-ndt", "to-compare", "poses", "kept")}
    words = {
        "ndt": [
            "follow", "--scans", address["to-ndt"], "--publish", address["poses"],
            "--odometry", str(odometry_file), "--plot", str(work / "ndt.svg"), *ndt,
        ],
        "compare": [
            "follow", "--scans", address["to-compare"], "--out", address["kept"], "--quiet", "--wait", "60",
            "--picture", str(work / "compare.svg"), *compare,
        ],
        "elevation": ["build", "--cache", str(work / "elevation"), "--quiet", *elevation],
    }  # fmt: skip
    modules = {"ndt": "ndt_scan_matcher", "compare": "compare_map_filter", "elevation": "elevation_map"}
    programs = result.programs
    for name, module in modules.items():
        line = [*words[name], "--endpoint", endpoint, "--json"]
        programs[name] = ProgramRun(name, f"shmmap_clients.{module}", line, work)
    began_s = time.monotonic()
    with contextlib.ExitStack() as stack:
        outputs = [stack.enter_context(ScanPublisher(address[name])) for name in ("to-ndt", "to-compare")]
        answers = stack.enter_context(_Answers(address["poses"], address["kept"], result))
        for program in programs.values():
            stack.enter_context(program)
        for output in outputs:
            if not output.wait_for_subscriber(_ANSWER_S):
                raise InternalError(f"no program connects to {output.endpoint}")
        for scan in scans:
            answers.wait(result.scans - _IN_FLIGHT, programs)
            for output in outputs:
                output.send(scan)
            result.scans += 1
            answers.expect(scan.name)
            _sample(result, programs, Path(shm_dir), instance)
            if not programs["elevation"].running:
                programs["elevation"].complete()
                # from the map again, not from its cache
                shutil.rmtree(work / "elevation", ignore_errors=True)
                programs["elevation"].start()
        for output in outputs:
            output.send(None)
        answers.wait(result.scans, programs)
        for program in programs.values():
            program.complete()
    result.seconds = time.monotonic() - began_s
    return result


class _Answers:
    """Receives what the two programs give back for each scan."""

    def __init__(self, poses: str, kept: str, result: ThreePrograms) -> None:
        self._context = zmq.Context()
        self._poller = zmq.Poller()
        self._sockets = {}
        for name, endpoint in (("ndt", poses), ("compare", kept)):
            socket = self._context.socket(zmq.SUB)
            socket.linger = 0
            socket.connect(endpoint)
            socket.subscribe(b"")
            self._sockets[socket] = name
            self._poller.register(socket, zmq.POLLIN)
        self._numbers: dict[str, int] = {}
        self._answered = {"ndt": -1, "compare": -1}
        self._result = result
        result.acknowledged = {"ndt": 0, "compare": 0}

    def __enter__(self) -> _Answers:
        return self

    def __exit__(self, *_: object) -> None:
        for socket in self._sockets:
            socket.close(0)
        self._context.term()

    def expect(self, name: str) -> None:
        """A scan of this name was sent."""
        self._numbers[name] = len(self._numbers)

    def wait(self, count: int, programs: dict[str, ProgramRun]) -> None:
        """Wait until both have answered the first ``count`` scans, or a later one."""
        quiet_s = time.monotonic()
        while min(self._answered.values()) < count - 1:
            ready = self._poller.poll(_POLL_MS)
            for socket, _ in ready:
                self._receive(socket)
            if ready:
                quiet_s = time.monotonic()
                continue
            for name, last in self._answered.items():
                if last < count - 1 and not programs[name].running:
                    raise InternalError(f"{name} ended early: {programs[name].last_words()}")
            if time.monotonic() - quiet_s > _ANSWER_S:
                raise InternalError(f"no answer for {_ANSWER_S:g} s; answered so far: {self._answered}")

    def _receive(self, socket: zmq.Socket[bytes]) -> None:
        program = self._sockets[socket]
        frames = socket.recv_multipart()
        if program == "ndt":
            name = str(msgspec.msgpack.decode(frames[0])["name"])
        else:
            scan = decode_scan(frames)
            if scan is None:
                return
            name = scan.name
        self._answered[program] = max(self._answered[program], self._numbers[name])
        self._result.acknowledged[program] += 1


def _sample(result: ThreePrograms, programs: dict[str, ProgramRun], shm_dir: Path, instance: str) -> None:
    """Look at the memory of the programs, and at the daemon's segments."""
    for program in programs.values():
        program.sample()
    before, after = _segments(shm_dir, instance), _segments(shm_dir, instance)
    # what was there both times was there at once; a sum over names as they come and go would be too large
    result.segment_bytes.append(sum(after[inode][1] for inode in before.keys() & after.keys()))
    result.segments_seen.update(name.removesuffix(".zombie") for name, _ in after.values())


def _segments(shm_dir: Path, instance: str) -> dict[int, tuple[str, int]]:
    """Name and bytes of each file of the daemon, by inode."""
    found = {}
    for path in shm_dir.glob(f"shmmap.{instance}.*"):
        with contextlib.suppress(OSError):
            status = path.stat()
            found[status.st_ino] = (path.name, status.st_blocks * 512)
    return found


def table(result: ThreePrograms) -> list[str]:
    """Return the result as lines for people."""
    mib = 1 << 20
    peak = max(result.segment_bytes, default=0)
    copy = (
        f"{result.scans} scans in {result.seconds:.0f} s on one copy of the map: {peak / mib:.0f} MiB of"
        f" shared memory at most, {len(result.segments_seen)} segments came and went"
    )
    names = f"{'scans':>8}{'p50':>11}{'p99':>11}{'own memory':>14}{'growth':>12}{'map attached':>14}"
    lines = [copy, f"{'':11}{names}"]
    for name, run in result.programs.items():
        spread = run.document.get({"ndt": "latency_ms", "compare": "compare_ms"}.get(name, ""))
        p50, p99 = (f"{spread[key]:.1f} ms" if spread else "-" for key in ("p50", "p99"))
        scans = result.acknowledged.get(name, 0)
        own, growth, shared = (
            value / mib for value in (max(run.own_bytes, default=0), run.growth_bytes, run.shared_bytes)
        )
        memory = f"{own:10.0f} MiB{growth:8.1f} MiB{shared:10.0f} MiB"
        lines.append(f"{name:11}{scans or '-':>8}{p50:>11}{p99:>11}{memory}")
    ndt, compare, elevation = (result.programs[name].document for name in ("ndt", "compare", "elevation"))
    lines.append(
        f"elevation: {result.programs['elevation'].runs} times the whole map of {elevation['cells']} cells"
    )
    lines.append(
        f"localized {ndt['frames']} of {result.scans} scans ({ndt['trustworthy']} to be trusted), compared"
        f" {compare['scans']} ({compare['incomplete_scans']} with cells missing)"
    )
    if compare["first_missing"]:
        lines.append(f"missing: {compare['first_missing']}")
    return lines
