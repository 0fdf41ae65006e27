# SPDX-License-Identifier: Apache-2.0
"""What was mapped is exported as a divided map, which a daemon serves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from shmmap.chunks.voxels import voxel_centers
from tests.process.conftest import DaemonFactory
from tests.support.forked_programs import run_verb
from tests.support.live_drive import RESOLUTION
from tests.support.live_reference import stored_drive
from tests.support.raw_client import RawClient, circle
from tests.support.segment_reader import read_segment

Connect = Callable[..., RawClient]


def test_what_was_mapped_is_served(daemon: DaemonFactory, connect: Connect, tmp_path: Path) -> None:
    voxels = stored_drive(tmp_path / "lidar")
    occupied = sorted(voxel for voxel, value in voxels.items() if value > 0)
    done = run_verb(["live", "export", str(tmp_path / "lidar"), "-o", str(tmp_path / "map")])
    assert done.returncode == 0, done.stderr
    client = connect(daemon(tmp_path / "map"))
    reply = client.area(circle(0.0, 0.0, 1000.0))
    assert (reply.pending, reply.failed) == ([], [])
    segments = [read_segment(client.path(handle)) for handle in reply.cells]
    points = np.concatenate([segment.columns["xyz"] for segment in segments])
    assert len(segments) > 3
    middles = voxel_centers(np.array(occupied), RESOLUTION).astype(np.float32)
    assert sorted(map(tuple, points.tolist())) == sorted(map(tuple, middles.tolist()))
    assert all((segment.columns["intensity"] > 0.5).all() for segment in segments)
