# SPDX-License-Identifier: Apache-2.0
"""Pages of the repository as their readers use them: named blocks, links, commands typed at a terminal."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from shmmap.testing.daemon_process import without_settings
from tests.support.daemon_process import ROOT, Deadline, processes_marked, until, wait_ended, wait_readable

_BLOCK = re.compile(r"^<!-- ([\w-]+) -->\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class Page:
    """One Markdown file."""

    path: Path
    text: str

    @property
    def blocks(self) -> dict[str, list[str]]:
        """Lines of each fenced block that follows a comment ``<!-- name -->``."""
        found = _BLOCK.findall(self.text)
        assert len(found) == len(dict(found)), f"{self.path}: two blocks of one name"
        return {name: code.splitlines() for name, code in found}

    def commands(self, name: str) -> list[str]:
        """Commands of a block: no empty lines and comments, ends of continued lines joined."""
        joined = "\n".join(self.blocks[name]).replace("\\\n", " ")
        return [line for line in joined.splitlines() if line.strip() and not line.startswith("#")]

    @property
    def fences(self) -> int:
        """How many blocks of code there are, with a name or without; what has no language is a drawing."""
        return len(re.findall(r"^ *```\w+$", self.text, re.MULTILINE))

    @property
    def links(self) -> list[str]:
        """Targets of all links and pictures."""
        return _LINK.findall(self.text)

    @property
    def anchors(self) -> set[str]:
        """Anchors that the page's headings have where it is shown."""
        prose = re.sub(r"^```.*?^```$", "", self.text, flags=re.MULTILINE | re.DOTALL)
        return {heading_anchor(title) for title in re.findall(r"^#+ (.+)$", prose, re.MULTILINE)}


def heading_anchor(title: str) -> str:
    """Return a heading's anchor: lower case, blanks as hyphens, no other signs."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def read_page(name: str) -> Page:
    """Return the page at a path relative to the repository."""
    path = ROOT / name
    return Page(path, path.read_text(encoding="utf-8"))


def all_pages() -> list[str]:
    """Return every page of the repository: paths relative to it."""
    folders = (".github", "clients", "shmmap", "systemd", "tests")
    found = [path for folder in folders for path in (ROOT / folder).rglob("*.md")]
    return sorted(str(path.relative_to(ROOT)) for path in [*ROOT.glob("*.md"), *found])


# --- a reader who follows a page: a home, terminals, and commands typed as they stand -----------------

_SERVE_S = 180.0  # a cloud is divided and kernels are compiled before a first daemon is ready


def listens(port: int) -> bool:
    """Whether a server of this machine takes connections at a port."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


class Terminal:
    """A shell of a reader, which keeps directory and environment from one command to the next."""

    def __init__(self, environment: dict[str, str], cwd: Path, state: Path) -> None:
        self._environment = environment
        self._cwd = cwd
        self._state = state

    def _script(self, command: str) -> str:
        state = shlex.quote(str(self._state))
        return (
            f"[ -e {state} ] && . {state}; set -eu\n"
            f'trap \'{{ export -p; printf "cd %q\\n" "$PWD"; }} >{state}\' EXIT\n{command}\n'
        )

    def run(self, command: str) -> str:
        """Run one command to its end; return what it printed."""
        done = subprocess.run(
            ["bash", "-c", self._script(command)],
            cwd=self._cwd,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout

    def python(self, program: Sequence[str]) -> str:
        """Run a program of a page with the terminal's ``python``."""
        path = self._state.with_suffix(".py")
        path.write_text("\n".join(program) + "\n", encoding="utf-8")
        return self.run(f"python {shlex.quote(str(path))}")

    @contextlib.contextmanager
    def web_server(self, command: str, port: int) -> Iterator[None]:
        """Run a web server from when it listens until the end of the block."""
        server = subprocess.Popen(
            ["bash", "-c", self._script(command).replace(command, f"exec {command}")],
            cwd=self._cwd,
            env=self._environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            waiting = Deadline()
            while waiting(not listens(port)):
                assert server.poll() is None, command
                time.sleep(0.01)
            yield
        finally:
            server.kill()
            server.wait()

    @contextlib.contextmanager
    def running(self, command: str, **variables: str) -> Iterator[subprocess.Popen[bytes]]:
        """Run a program without end until the end of the block, when Ctrl-C has to end it well."""
        script = self._script(command).replace(command, f"exec {command}")
        log = self._state.with_suffix(".log")
        with log.open("w") as output:
            program = subprocess.Popen(
                ["bash", "-c", script],
                cwd=self._cwd,
                env=self._environment | {"PYTHONFAULTHANDLER": "1", **variables},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
        try:
            yield program
        finally:
            program.send_signal(signal.SIGINT)
            ended = wait_ended(program.pid)
            state = "" if ended else Path(f"/proc/{program.pid}/status").read_text(encoding="utf-8")
            if not ended:
                program.send_signal(signal.SIGABRT)  # its log then has each thread's stack
                program.send_signal(signal.SIGCONT)
            code = program.wait()
        assert ended, f"{command}: Ctrl-C did not end it\n{state}\n{log.read_text()}"
        assert code == 0, f"{command}: {code}\n{log.read_text()}"

    @contextlib.contextmanager
    def serving(self, command: str) -> Iterator[None]:
        """Run a daemon from its readiness until it is stopped with Ctrl-C."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
            address = f"\0{self._state}"  # abstract: no path is too long, nothing is left
            ready.bind(address)
            with self.running(command, NOTIFY_SOCKET="@" + address[1:]) as daemon:
                fd = os.pidfd_open(daemon.pid)
                came = wait_readable([ready.fileno(), fd], _SERVE_S)
                os.close(fd)
                log = self._state.with_suffix(".log")
                assert came == [ready.fileno()], f"{command}: the daemon did not get ready\n{log.read_text()}"
                yield


class Reader:
    """A reader with nothing configured.

    Parameters
    ----------
    home
        An empty directory: home, and where the first terminal opens.
    path
        Directories of programs that come before the system's.
    variables
        Further variables of the environment.
    """

    def __init__(self, home: Path, path: Sequence[Path], variables: dict[str, str] | None = None) -> None:
        self.home = home
        self.mark = f"{home.name}.{os.getpid()}"
        self.shm_dir = Path(tempfile.mkdtemp(prefix="shmmap-reader-", dir="/dev/shm"))
        self._run_dir = Path(tempfile.mkdtemp(prefix="shmmap-reader-"))  # short: it holds sockets
        self._terminals = 0
        directories = [str(one) for one in path] + os.environ["PATH"].split(":")
        self._environment = {
            **{name: value for name, value in without_settings().items() if name != "PYTHONPATH"},
            "PATH": ":".join(directories),
            "HOME": str(home),
            "XDG_RUNTIME_DIR": str(self._run_dir),
            "XDG_CACHE_HOME": str(home / ".cache"),
            "SHMMAP_SHM_DIR": str(self.shm_dir),
            "SHMMAP_TEST_RUN": self.mark,
            **(variables or {}),
        }
        self._environment.pop("VIRTUAL_ENV", None)

    def terminal(self, cwd: Path | None = None) -> Terminal:
        """Open a terminal."""
        self._terminals += 1
        state = self._run_dir / f"terminal{self._terminals}"
        return Terminal(self._environment, cwd or self.home, state)

    def leave(self) -> None:
        """Remove what the reader had; fails where a process or a segment was left behind."""
        try:
            until(lambda: not processes_marked(self.mark))  # on a busy machine they take a moment to end
            assert list(self.shm_dir.iterdir()) == []
        finally:
            shutil.rmtree(self.shm_dir)
            shutil.rmtree(self._run_dir)


def write_program(path: Path, text: str) -> None:
    """Write a program of a shell."""
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


_PROGRAMS = {
    "shmmap": "-m shmmap.cli",
    "shmmap-compare": "-m shmmap_clients.compare_map_filter",
    "shmmap-ndt": "-m shmmap_clients.ndt_scan_matcher",
    "shmmap-pose-init": "-m shmmap_clients.pose_initializer",
    "shmmap-rolling": "-m shmmap_clients.rolling_map",
    "python": "",
    "python3": "",
}


@contextlib.contextmanager
def reader_with_programs(home: Path, **variables: str) -> Iterator[Reader]:
    """Have a reader whose programs are this tree's and this interpreter's."""
    programs = home / "bin"
    programs.mkdir()
    for name, words in _PROGRAMS.items():
        write_program(programs / name, f'exec "{sys.executable}" {words} "$@"')
    reader = Reader(home, [programs], {"PYTHONPATH": f"{ROOT}:{ROOT / 'clients'}", **variables})
    try:
        yield reader
    finally:
        reader.leave()
