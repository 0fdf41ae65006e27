# SPDX-License-Identifier: Apache-2.0
"""What the checks look at: a machine, the daemon's settings on it, and what its daemon reports."""

from __future__ import annotations

import os
import pwd
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final

from shmmap.daemon.config import DaemonConfig
from shmmap.doctor.store_probe import StoreAnswer, StoreQuestion, ask_store
from shmmap.errors import ShmmapError
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.snapshot import Snapshot

__all__ = ["Diagnosis", "Machine", "answering_at"]


@dataclass(frozen=True, slots=True)
class Machine:
    """Files of the machine; a test's machine lies in a directory."""

    root: Path = Path("/")

    def path(self, name: str) -> Path:
        """Where an absolute name of the machine is found."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str:
        """Content of a file; empty when there is none or it cannot be read."""
        try:
            return self.path(name).read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""


@dataclass(frozen=True)
class Diagnosis:
    """A machine and an instance of the daemon, as the account ``uid`` sees them."""

    machine: Machine
    config: DaemonConfig
    file: str
    """The file that the settings are from; empty: none."""
    socket: str
    seen: Snapshot | None
    """The daemon's statistics; None where they cannot be read, and ``unreadable`` says why."""
    unreadable: str = ""
    uid: int = field(default_factory=os.geteuid)
    answering: int = 0
    """Process of a daemon of this instance that answers although it has no statistics; 0: none."""

    @property
    def counters(self) -> Mapping[str, int]:
        """The living daemon's counters; empty where none lives."""
        return self.seen.counters if self.seen is not None and self.alive else {}

    @property
    def _identity(self) -> DaemonIdentity | None:
        return self.seen.identity if self.seen is not None and self.alive else None

    @property
    def alive(self) -> bool:
        """Whether the daemon's process lives."""
        return self.seen is not None and self.seen.state in ("healthy", "starting", "stopped", "hung")

    @property
    def awaits_first_client(self) -> bool:
        """Whether no daemon lives, and another process (the service manager) listens for it.

        Connecting would start it, and a diagnosis must not do that.
        """
        if self.alive or self.seen is None or self.answering:
            return False
        return self.socket in self.listening

    @property
    def listening(self) -> set[str]:
        """Paths of all sockets at which a process listens."""
        rows = (line.split(maxsplit=7) for line in self.machine.text("/proc/net/unix").splitlines())
        return {row[7] for row in rows if len(row) == 8 and row[7][0] == "/" and int(row[3], 16) & _LISTENS}

    @property
    def shm_dir(self) -> str:
        """Where the segments are."""
        identity = self._identity
        return (identity.shm_dir if identity else "") or self.config.shm_dir

    @property
    def map_path(self) -> str:
        """The map that is served, or would be."""
        identity = self._identity
        return (identity.map_path if identity else "") or self.config.map_path

    @property
    def budget_bytes(self) -> int:
        """The budget in force; the configured one (0: chosen at start) where no daemon runs."""
        return self.counters.get("budget_bytes", 0) if self.alive else self.config.budget_bytes

    @property
    def pid(self) -> int:
        """The daemon's process, 0 where none lives or it is in another pid namespace."""
        pid = self._identity.pid if self._identity else 0
        return pid if pid and self.machine.path(f"/proc/{pid}").exists() else 0

    @cached_property
    def environment(self) -> dict[str, str] | None:
        """The daemon's environment; None where none lives, or this account may not see it."""
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
        """What the store of a published map answers, asked once."""
        question = StoreQuestion(
            self.map_path,
            self.config.insecure_http or self.alive,  # a daemon that serves it was allowed to
            self.config.instance_credentials,
            self.counters.get("published_version", 0),
        )
        return ask_store(question, self.environment)

    @property
    def is_service(self) -> bool:
        """Whether the settings are those of the installed service."""
        return self.file.startswith("/etc/") and self.machine.path(_UNIT).exists()

    @property
    def runs_as(self) -> int:
        """Account of the daemon: the running one's, else the installed service's, else ``uid``."""
        if self.pid:
            return self.machine.path(f"/proc/{self.pid}").stat().st_uid
        if self.is_service:
            try:
                return pwd.getpwnam("shmmap").pw_uid
            except KeyError:
                return self.uid
        return self.uid


ASKED_S: Final = 2.0
_UNIT: Final = "/etc/systemd/system/shmmapd.service"
_LISTENS: Final = 1 << 16  # __SO_ACCEPTCON of linux/net.h


def answering_at(path: str) -> dict[str, int]:
    """Ask the process that listens at a socket: the process of the daemon there, by its instance."""
    from shmmap.client.client import connect
    from shmmap.client.discovery import is_served

    if not is_served(path):
        return {}
    try:
        with connect(path, timeout=ASKED_S, connect_timeout=ASKED_S, name="shmmap doctor") as client:
            return {client.welcome.instance: client.welcome.pid}
    except ShmmapError:
        return {}
