# SPDX-License-Identifier: Apache-2.0
"""nginx on loopback, with a configuration of the test: as a plain web server, or as a gateway."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

import pytest

from tests.support.patience import Patience

__all__ = ["Nginx", "free_port", "needed_nginx", "web_server"]

_PLACES = f"{os.environ.get('PATH', '')}{os.pathsep}/usr/sbin{os.pathsep}/usr/local/sbin"

_WEB = """\
worker_processes 1;
pid {folder}/nginx.pid;
events {{ worker_connections 256; }}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    server {{
        listen 127.0.0.1:{port};
        root {root};
        {more}
    }}
}}
"""


def needed_nginx() -> str:
    """Path of nginx; the test is skipped where there is none."""
    found = shutil.which("nginx", path=_PLACES)
    if found is None:
        pytest.skip("nginx is not installed")
    return found


def free_port() -> int:
    """A port that was free a moment ago."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


def web_server(root: Path, folder: Path, port: int, more: str = "") -> str:
    """Configuration of a plain web server of a directory."""
    return _WEB.format(folder=folder, port=port, root=root, more=more)


class Nginx:
    """nginx with a configuration, in a process group of its own; its files lie in ``folder``."""

    def __init__(self, configuration: str, folder: Path, port: int) -> None:
        self.port = port
        self.folder = folder
        folder.mkdir(exist_ok=True)
        self._file = folder / "nginx.conf"
        self._process: subprocess.Popen[bytes] | None = None
        self.configure(configuration)

    @property
    def command(self) -> list[str]:
        """Its command: as root its workers stay root, the owner of the tests' directories."""
        user = " user root;" if os.geteuid() == 0 else ""
        log = str(self.folder / "error.log")
        options = ["-p", str(self.folder), "-c", str(self._file), "-e", log, "-g", f"daemon off;{user}"]
        return [needed_nginx(), *options]

    def configure(self, configuration: str) -> None:
        """Take another configuration, from the next start on."""
        self._file.write_text(configuration)

    def start(self) -> None:
        """Start it, and wait until it listens."""
        process = self._process = subprocess.Popen(self.command, start_new_session=True)
        waiting = Patience()
        while waiting(not self._listens()):
            assert process.poll() is None, (self.folder / "error.log").read_text()
            time.sleep(0.01)

    def _listens(self) -> bool:
        with socket.socket() as one:
            return one.connect_ex(("127.0.0.1", self.port)) == 0

    def kill(self) -> None:
        """Kill all of its processes: transfers end where they are."""
        process, self._process = self._process, None
        if process is not None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def connections(self) -> int:
        """How many connections its workers have open."""
        here = f"0100007F:{self.port:04X}"
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        return sum(row[1] == here and row[3] == "01" for row in rows)
