# SPDX-License-Identifier: Apache-2.0
"""The examples of ``clients/README.md`` run as they stand."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap

Factory = Callable[..., DaemonProcess]

README = (ROOT / "clients" / "README.md").read_text(encoding="utf-8")
BLOCKS = dict(re.findall(r"^<!-- ([\w-]+) -->\n```python\n(.*?)^```$", README, re.MULTILINE | re.DOTALL))
EXPECTED = {
    "ndt": r"\d+ Gaussians, NVTL \d",
    "pose-init": r"score \d+\.\d+, reliable: (True|False)",
    "compare": r"\d{4,6} points are not in the map",
    "elevation": r"lowest points ahead: \[.*\d",
    "elevation-whole": r"36 cells, \d+ of \d+ columns",
}


def test_every_example_is_run() -> None:
    assert README.count("```python\n") == len(BLOCKS)
    assert set(BLOCKS) >= set(EXPECTED)


@pytest.mark.parametrize("name", EXPECTED)
def test_example(daemon: Factory, divided_map: DividedMap, tmp_path: Path, name: str) -> None:
    code = BLOCKS[name]
    assert len([line for line in code.splitlines() if line.strip()]) <= 12
    one = daemon(divided_map.root)
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120.0,
        cwd=tmp_path,
        env={**os.environ, "SHMMAP_ENDPOINT": one.endpoint, "SHMMAP_SHM_DIR": one.shm_dir},
    )
    assert done.returncode == 0, done.stderr
    assert re.search(EXPECTED[name], done.stdout), done.stdout
