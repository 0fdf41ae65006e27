# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap demo --live`` says in the end."""

from __future__ import annotations

from dataclasses import replace

import pytest

from shmmap.cli.screens.live_demo_report import live_demo_json, print_live_report
from shmmap.demo.live_drive import LiveDriveResult
from shmmap.demo.live_mapping import Kills

RESULT = LiveDriveResult(
    scans=181, points=2_060_000, length_m=450.0, chunks=300, file_bytes=3_000_000, given_up=400, came_back=90,
    budget_bytes=4 << 20, most_bytes=3 << 20, active=1_000_000, active_bytes=3_140_000,
    kills=Kills(60, 1.25, 70, 120, 119), mapping_s=9.0, voxels=4_000_000, differing=0, picture_svg="",
)  # fmt: skip


def told(capsys: pytest.CaptureFixture[str], result: LiveDriveResult) -> dict[str, str]:
    print_live_report(result, "live.svg", 31.0)
    found: dict[str, str] = {}
    name = ""
    for line in capsys.readouterr().out.splitlines()[1:]:
        assert len(line) <= 79
        name = line[:10].strip() or name
        found[name] = f"{found.get(name, '')} {line[10:]}".strip()
    return found


def test_what_was_mapped_killed_and_compared(capsys: pytest.CaptureFixture[str]) -> None:
    lines = told(capsys, RESULT)
    assert list(lines) == ["drive", "map", "memory", "kill -9", "compared", "duration"]
    assert lines["drive"].startswith("181 LiDAR scans, 2.1 million points, on 450 m; mapped in 9")
    assert lines["map"].startswith(
        "300 chunks, 4 000 000 known voxels; each takes 3.1 bytes in memory, 0.8 on"
    )
    assert "400 times a chunk was saved and given up, 90 times one came back" in lines["memory"]
    assert "the daemon after scan 60: back in 1.2" in lines["kill -9"]
    assert lines["kill -9"].endswith("after scan 120: its next run went on with scan 119")
    assert lines["compared"].startswith("all 4 000 000 voxels on disk are as in a map without bounds")
    assert lines["duration"].endswith("; picture: live.svg")
    assert live_demo_json(RESULT, "live.svg", 31.0)["mapper"] == {"killed_at": 120, "resumed_at": 119}


def test_a_voxel_that_differs(capsys: pytest.CaptureFixture[str]) -> None:
    lines = told(capsys, replace(RESULT, differing=12))
    assert lines["compared"].startswith("12 of 4 000 000 voxels on disk are NOT as in a map")
