# SPDX-License-Identifier: Apache-2.0
"""The live demonstration's drive, scan after scan: who maps, who watches, and who is killed when."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from shmmap.chunks.voxels import ChunkKey
from shmmap.demo.demo_town import Progress
from shmmap.demo.program import Program
from shmmap.errors import InternalError
from shmmap.testing.daemon_process import DaemonProcess

if TYPE_CHECKING:
    from shmmap.client.live.live_map import LiveMap

__all__ = ["PATIENCE_S", "Kills", "Mapping", "Watch", "map_all"]

PATIENCE_S: Final = 300.0
"""For a compiler on a slow machine."""
_WITHOUT_DAEMON: Final = 2  # scans that come while there is none


class Mapping:
    """The mapping program, one life after the other."""

    def __init__(self, live_map: str, endpoint: str, scans_dir: Path, scratch: Path) -> None:
        words = [endpoint, live_map, str(scans_dir)]
        self._program = Program("mapper", "shmmap.demo.live_mapper", words, scratch, piped=True, fed=True)
        self._lines: Iterator[str] = iter(())

    def __enter__(self) -> Mapping:
        return self

    def __exit__(self, *_: object) -> None:
        self._program.kill()

    def start(self) -> int:
        """Start it; returns the scan that the map wants next."""
        self._program.start()
        self._lines = self._program.lines(PATIENCE_S)
        return self._hear("next")

    def send(self, number: int) -> None:
        """Have it map a scan."""
        self._program.tell(str(number))

    def hear(self) -> int:
        """Wait until a scan is on its way; returns how many are in the map."""
        return self._hear("applied")

    def kill(self) -> None:
        """End it with SIGKILL."""
        self._program.kill()

    def finish(self) -> None:
        """Wait until all scans are in the map, and end it."""
        self._program.tell_no_more()
        self._hear("applied")
        if code := self._program.wait(PATIENCE_S):
            raise InternalError(f"the mapping program ended with {code}: {self._program.last_words()}")

    def _hear(self, what: str) -> int:
        found: dict[str, int] = json.loads(next(self._lines, "{}"))
        if what not in found:
            raise InternalError(f"the mapping program ended early: {self._program.last_words()}")
        return found[what]


class Watch:
    """Counts chunks that leave memory, and that come back into it.

    Attributes
    ----------
    given_up, came_back
        How often.
    most_bytes
        The most memory that those in service took.
    """

    def __init__(self, live: LiveMap) -> None:
        self.live = live
        self.given_up = self.came_back = self.most_bytes = 0
        self._there: set[ChunkKey] = set()
        self._saved: set[ChunkKey] = set()

    def look(self) -> str:
        """Look at all chunks in which something is known; returns how many are where."""
        there: set[ChunkKey] = set()
        saved: set[ChunkKey] = set()
        for row in self.live.chunks(saved=True):
            if row.active:
                (saved if row.state == "saved" else there).add(row.key)
        self.given_up += len(self._there & saved)
        self.came_back += len(self._saved & there)
        self._there, self._saved = there, saved
        self.most_bytes = max(self.most_bytes, self.live.status().bytes)
        return f"{len(there)} chunks in memory, {len(saved)} on disk alone; {self.came_back} came back"


@dataclass(slots=True)
class Kills:
    """What was killed, and how it went on.

    Attributes
    ----------
    daemon_at, down_s, kept
        Scan after which the daemon was killed, seconds until it was back, and chunks that it found in memory.
    mapper_at, resumed_at
        Scan after which the mapping program was killed, and with which its next run went on.
    """

    daemon_at: int = 0
    down_s: float = 0.0
    kept: int = 0
    mapper_at: int = 0
    resumed_at: int = 0


def map_all(scans: int, mapping: Mapping, watch: Watch, daemon: DaemonProcess, progress: Progress) -> Kills:
    """Map scan after scan; both are killed right after a scan was sent, which may be in the map or not."""
    progress.stage("Mapping it, with memory for a part of the map", scans)
    kills = Kills()
    number = mapping.start()
    while number <= scans:
        mapping.send(number)
        mapping.hear()
        progress.step(note=f"scan {number}: {watch.look()}")
        if not kills.mapper_at and number >= scans // 3:
            kills.mapper_at = number
            mapping.kill()
            progress.event(f"The mapping program is killed (SIGKILL) after scan {number}")
            number = kills.resumed_at = mapping.start()
            progress.event(f"Its next run hears from the daemon that scan {number} comes next")
            continue
        if not kills.daemon_at and number >= 2 * scans // 3:
            kills.daemon_at = number
            sent = range(number + 1, min(number + _WITHOUT_DAEMON, scans) + 1)
            _kill_daemon(kills, mapping, daemon, progress, sent)
            number += len(sent)
        number += 1
    return kills


def _kill_daemon(
    kills: Kills, mapping: Mapping, daemon: DaemonProcess, progress: Progress, sent: range
) -> None:
    """Kill the daemon, send scans that nobody hears, start it again."""
    daemon.kill()
    killed_s = time.perf_counter()
    progress.event(f"The daemon is killed (SIGKILL) after scan {kills.daemon_at}; the drive goes on")
    for number in sent:
        mapping.send(number)
    daemon.start(PATIENCE_S)
    kills.down_s = time.perf_counter() - killed_s
    kills.kept = _found_in_memory(daemon)
    progress.event(f"It is back; it found {kills.kept} chunks in memory")
    for _ in sent:
        mapping.hear()
        progress.step()


def _found_in_memory(daemon: DaemonProcess) -> int:
    """Chunks that the daemon's present life took over; it may have given some up since."""
    found = re.findall(r" live map in memory .* chunks=(\d+)", daemon.log)
    return int(found[-1]) if found else 0
