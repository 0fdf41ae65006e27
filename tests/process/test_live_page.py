# SPDX-License-Identifier: Apache-2.0
"""LIVE_MAPS.md is true: its commands and programs run as they stand, one after the other."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT
from tests.support.pages import Reader, read_page

PAGE = read_page("shmmap/client/live/LIVE_MAPS.md")


def test_every_block_is_tested() -> None:
    assert set(PAGE.blocks) == {"serve", "map", "read"}
    assert PAGE.fences == len(PAGE.blocks)


def test_a_wall_is_mapped_and_read(tmp_path: Path) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, words in (("shmmap", "-m shmmap.cli"), ("python", "")):
        script = programs / name
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n')
        script.chmod(0o755)
    reader = Reader(tmp_path, [programs], {"PYTHONPATH": str(ROOT)})
    try:
        (serve,) = PAGE.commands("serve")
        with reader.terminal().serving(serve):
            user = reader.terminal()
            assert user.python(PAGE.blocks["map"]) == "5 scans applied\n"
            listed, free, ray = user.python(PAGE.blocks["read"]).splitlines()
            voxels = re.fullmatch(r"(\d+) voxels, up to (0\.\d+)", listed)
            assert voxels is not None
            assert int(voxels[1]) > 1000
            assert float(voxels[2]) == pytest.approx(0.97, abs=0.02)
            assert free == "free at 1 m: True"
            assert re.fullmatch(r"a ray gets to (3\.0|3\.1|2\.9) m", ray)
            assert "lidar" in user.run("shmmap live ls")
            assert "on the disk" in user.run("shmmap live save lidar")
            user.run("shmmap live export maps/lidar -o wall.ply")
    finally:
        reader.leave()
