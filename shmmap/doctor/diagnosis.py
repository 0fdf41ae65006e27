# SPDX-License-Identifier: Apache-2.0
"""The input of the checks: a machine, the daemon's settings on it, and the daemon's reports."""

from __future__ import annotations

import os
import pwd
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final

from shmmap.daemon.config import DaemonConfig
from shmmap.doctor.daemon_lists import ANSWER_S
from shmmap.doctor.store_probe import StoreAnswer, StoreQuestion, ask_store
from shmmap.errors import ShmmapError
from shmmap.mounts import Mount, mount_of
from shmmap.origin.remote.store import is_published, is_url
from shmmap.protocol.rows import LiveMapRow
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.reader import Snapshot


@dataclass(frozen=True, slots=True)
class Machine:
    """The files of a machine; in tests the machine is a directory."""

    root: Path = Path("/")

    def path(self, name: str) -> Path:
        """Return the actual path of an absolute path of the machine."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str:
        """Return the text of a file; empty if it is missing or unreadable."""
        try:
            return self.path(name).read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""

    def mount_of(self, path: str) -> Mount:
        """Return the mount that a path is on."""
        return mount_of(path, str(self.root))


@dataclass(frozen=True)
class Diagnosis:
    """A machine and an instance of the daemon, as seen by the account ``uid``."""

    machine: Machine
    config: DaemonConfig
    file: str
    """Configuration file of the settings; empty: none."""
    socket: str
    seen: Snapshot | None
    """Statistics of the daemon; None if they are unreadable: ``unreadable`` is why, and what to do."""
    unreadable: tuple[str, str] = ("", "")
    uid: int = field(default_factory=os.geteuid)
    answering: int = 0
    """Process id of a daemon that answers for this instance but has no statistics; 0: none."""

    @property
    def counters(self) -> Mapping[str, int]:
        """Counters of the running daemon; empty if none runs."""
        return self.seen.counters if self.seen is not None and self.alive else {}

    @property
    def identity(self) -> DaemonIdentity | None:
        """Identity of the running daemon; None if none runs."""
        return self.seen.identity if self.seen is not None and self.alive else None

    @property
    def live_names(self) -> list[str]:
        """Names of the live maps that the running daemon keeps."""
        return self.identity.live.split() if self.identity else []

    @property
    def live_rows(self) -> Sequence[LiveMapRow]:
        """State of these maps; empty if the daemon does not answer."""
        return self.seen.live if self.seen is not None and self.alive else ()

    @property
    def alive(self) -> bool:
        """Whether the daemon's process exists."""
        return self.state in ("healthy", "starting", "stopped", "hung")

    @property
    def state(self) -> str:
        """State of the daemon by its statistics; empty if they are unreadable."""
        return self.seen.state if self.seen is not None else ""

    @property
    def awaits_first_client(self) -> bool:
        """Whether no daemon runs and another process (the service manager) listens on its socket.

        Connecting would start the daemon, which a diagnosis must not do.
        """
        if self.alive or self.seen is None or self.answering:
            return False
        return self.socket in self.listening

    @property
    def listening(self) -> set[str]:
        """Paths of all sockets on which a process listens."""
        rows = (line.split(maxsplit=7) for line in self.machine.text("/proc/net/unix").splitlines())
        return {row[7] for row in rows if len(row) == 8 and row[7][0] == "/" and int(row[3], 16) & _LISTENS}

    @property
    def shm_dir(self) -> str:
        """Directory of the segments."""
        return (self.identity.shm_dir if self.identity else "") or self.config.shm_dir

    @property
    def map_path(self) -> str:
        """Path of the map that is served, or is configured."""
        return (self.identity.map_path if self.identity else "") or self.config.map_path

    @property
    def is_published(self) -> bool:
        """Whether the map is a published one."""
        path = self.map_path
        return bool(path) and is_published(path if is_url(path) else str(self.machine.path(path)))

    @property
    def budget_bytes(self) -> int:
        """Budget in force; without a running daemon the configured one (0: chosen at start)."""
        return self.counters.get("budget_bytes", 0) if self.alive else self.config.budget_bytes

    @property
    def pid(self) -> int:
        """Process id of the daemon; 0 if none runs or it is in another pid namespace."""
        pid = self.identity.pid if self.identity else 0
        return pid if pid and self.machine.path(f"/proc/{pid}").exists() else 0

    @cached_property
    def environment(self) -> dict[str, str] | None:
        """Environment of the daemon; None if none runs, or this account may not read it."""
        if not self.pid:
            return None
        try:
            data = self.machine.path(f"/proc/{self.pid}/environ").read_bytes()
        except OSError:
            return None
        pairs = (os.fsdecode(pair).partition("=") for pair in data.split(b"\0") if pair)
        return {name: value for name, _, value in pairs}

    @cached_property
    def store(self) -> StoreAnswer:
        """Reply of a published map's store, requested once."""
        question = StoreQuestion(
            self.map_path,
            self.config.insecure_http or self.alive,  # the running daemon has accepted the URL
            self.config.instance_credentials,
            self.counters.get("published_version", 0),
        )
        return ask_store(question, self.environment)

    @property
    def is_service(self) -> bool:
        """Whether the settings belong to the installed service."""
        return self.file.startswith("/etc/") and self.machine.path(_UNIT).exists()

    @property
    def runs_as(self) -> int:
        """Account of the running daemon, else of the installed service, else ``uid``."""
        if self.pid:
            return self.machine.path(f"/proc/{self.pid}").stat().st_uid
        if self.is_service:
            try:
                return pwd.getpwnam("shmmap").pw_uid
            except KeyError:
                return self.uid
        return self.uid


_UNIT: Final = "/etc/systemd/system/shmmapd.service"
_LISTENS: Final = 1 << 16  # __SO_ACCEPTCON of linux/net.h


def answering_at(path: str) -> dict[str, int]:
    """Connect to a socket; return the daemon's process id by instance name."""
    from shmmap.client.client import connect
    from shmmap.client.discovery import is_served

    if not is_served(path):
        return {}
    try:
        with connect(path, timeout=ANSWER_S, connect_timeout=ANSWER_S, name="shmmap doctor") as client:
            return {client.welcome.instance: client.welcome.pid}
    except ShmmapError:
        return {}
