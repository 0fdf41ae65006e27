# SPDX-License-Identifier: Apache-2.0
"""What is examined: a machine, the daemon's settings on it, and what its daemon tells."""

from __future__ import annotations

import dataclasses
import os
import pwd
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final

from shmmap.daemon.config import DaemonConfig
from shmmap.doctor.store_probe import StoreAnswer, StoreQuestion, ask_store
from shmmap.errors import ShmmapError
from shmmap.segment.directory import DEFAULT_SHM_DIR
from shmmap.segment.names import usual_directory
from shmmap.statistics.reader import read_statistics
from shmmap.statistics.snapshot import Snapshot

__all__ = ["Machine", "Patient", "answering_at", "examine"]


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
class Patient:
    """What the checks look at.

    Attributes
    ----------
    machine
        The machine's files.
    config, file
        The daemon's settings, and the file they are from (empty: none).
    socket
        Path of the request socket.
    seen
        The daemon's statistics; None where they cannot be read, and ``unreadable`` says why.
    uid
        The account that asks.
    answering
        Process of a daemon of this instance that answers although it has no statistics; 0: none.
    """

    machine: Machine
    config: DaemonConfig
    file: str
    socket: str
    seen: Snapshot | None
    unreadable: str = ""
    uid: int = field(default_factory=os.geteuid)
    answering: int = 0

    @property
    def alive(self) -> bool:
        """Whether the daemon's process lives."""
        return self.seen is not None and self.seen.state in ("healthy", "starting", "stopped", "hung")

    @property
    def awaits_first_client(self) -> bool:
        """Whether no daemon lives, and somebody else (the service manager) listens for it.

        Connecting would start it, and who only looks must not do that.
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
        told = self.seen.identity.shm_dir if self.seen is not None and self.seen.identity else ""
        return told if self.alive and told else self.config.shm_dir

    @property
    def map_path(self) -> str:
        """The map that is served, or would be."""
        told = self.seen.identity.map_path if self.seen is not None and self.seen.identity else ""
        return told if self.alive and told else self.config.map_path

    @property
    def budget_bytes(self) -> int:
        """The budget in force; the configured one (0: chosen at start) where no daemon runs."""
        if self.alive and self.seen is not None:
            return self.seen.counters.get("budget_bytes", 0)
        return self.config.budget_bytes

    @property
    def pid(self) -> int:
        """The daemon's process, 0 where none lives or it is in another pid namespace."""
        if not self.alive or self.seen is None or self.seen.identity is None:
            return 0
        pid = self.seen.identity.pid
        return pid if self.machine.path(f"/proc/{pid}").exists() else 0

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
        counters = self.seen.counters if self.alive and self.seen is not None else {}
        question = StoreQuestion(
            self.map_path,
            self.config.insecure_http or self.alive,  # a daemon that serves it was allowed to
            self.config.instance_credentials,
            counters.get("published_version", 0),
        )
        return ask_store(question, self.environment)

    @property
    def is_service(self) -> bool:
        """Whether the settings are those of the installed service."""
        return self.file.startswith("/etc/") and self.machine.path(_UNIT).exists()

    @property
    def runs_as(self) -> int:
        """Account of the daemon: the living one's, else the installed service's, else who asks."""
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


def examine(config: DaemonConfig, file: str, machine: Machine | None = None) -> Patient:
    """Look at the machine and at what the instance's daemon tells."""
    if config.shm_dir == DEFAULT_SHM_DIR:
        config = dataclasses.replace(config, shm_dir=usual_directory(config.instance))
    try:
        seen, unreadable = read_statistics(config.instance, config.shm_dir), ""
    except ShmmapError as error:
        seen, unreadable = None, error.message
    except OSError as error:
        seen, unreadable = None, f"{config.shm_dir}: {error.strerror}"
    if seen is not None and seen.identity is not None and not (config.endpoint or config.runtime_dir):
        path = seen.identity.endpoint
    else:
        path = _socket(config)
    patient = Patient(machine or Machine(), config, file, path, seen, unreadable)
    if patient.alive:
        return patient
    return dataclasses.replace(patient, answering=answering_at(path).get(config.instance, 0))


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


def _socket(config: DaemonConfig) -> str:
    from shmmap.protocol.endpoint import runtime_dirs, socket_path

    if config.endpoint or config.runtime_dir:
        return config.socket()
    places = [socket_path(place, config.instance) for place in runtime_dirs()]
    return next((place for place in places if os.path.exists(place)), places[-1])
