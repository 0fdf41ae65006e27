# SPDX-License-Identifier: Apache-2.0
"""``shmmap metrics --listen`` while the daemon is away, healthy, stopped and killed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, Deadline
from tests.support.divided_map import DividedMap
from tests.support.metrics import listening


def scraped(url: str) -> dict[str, str]:
    """Values by name and labels but for the daemon's."""
    with urllib.request.urlopen(url, timeout=20) as answer:
        lines = answer.read().decode().splitlines()
    return dict(re.sub(r'\{daemon="[^"]*"', "{", line).rsplit(" ", 1) for line in lines if line[0] != "#")


def test_it_answers_whatever_the_daemon_does(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root, start=False)
    with listening(one) as url:
        assert scraped(url) == {"shmmap_up{}": "0"}
        one.start()
        cells = str(len(divided_map.corners))
        waiting = Deadline()
        while waiting(scraped(url).get("shmmap_map_cells{}") != cells):
            pass
        assert scraped(url)["shmmap_up{}"] == "1"
        one.send(signal.SIGSTOP)
        waiting = Deadline()
        while waiting(scraped(url)["shmmap_up{}"] != "0"):
            pass
        assert scraped(url)["shmmap_map_cells{}"] == cells, "what it last counted"
        one.send(signal.SIGCONT)
        waiting = Deadline()
        while waiting(scraped(url)["shmmap_up{}"] != "1"):
            pass
        one.kill()
        assert scraped(url)["shmmap_up{}"] == "0"
        one.start()
        assert scraped(url)["shmmap_up{}"] == "1"
        assert one.stop() == 0
        assert scraped(url) == {"shmmap_up{}": "0"}


def test_a_second_server_says_what_is_in_the_way(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with listening(one) as url:
        port = re.findall(r"\d+", url)[-1]
        done = subprocess.run(
            [sys.executable, "-m", "shmmap.cli", "metrics", "--listen", port],
            env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=Path("/"), capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 75
        assert f"another program listens at 127.0.0.1 port {port}" in done.stderr
