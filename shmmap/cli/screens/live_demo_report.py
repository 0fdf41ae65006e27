# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap demo --live`` says in the end: what was mapped, killed and compared."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.cli.screens.demo_report import print_texts
from shmmap.cli.screens.output import format_bytes, format_duration, print_line

if TYPE_CHECKING:
    from shmmap.demo.live_drive import LiveDriveResult

__all__ = ["live_demo_json", "print_live_report"]


def print_live_report(result: LiveDriveResult, picture: str, duration_s: float) -> None:
    """Print a line or two about each part."""
    print_line()
    print_texts(
        [
            ("drive", _drive(result)),
            ("map", _map(result)),
            ("memory", _memory(result)),
            ("kill -9", _kills(result)),
            ("compared", _compared(result)),
            ("duration", f"{format_duration(duration_s)}; picture: {picture}"),
        ]
    )


def _drive(result: LiveDriveResult) -> str:
    return (
        f"{result.scans} LiDAR scans, {result.points / 1e6:.1f} million points, on {result.length_m:g} m;"
        f" mapped in {format_duration(result.mapping_s)}, with both kills"
    )


def _map(result: LiveDriveResult) -> str:
    return (
        f"{result.chunks} chunks, {_spaced(result.voxels)} known voxels; each takes"
        f" {result.active_bytes / max(1, result.active):.1f} bytes in memory,"
        f" {result.file_bytes / max(1, result.voxels):.1f} on disk"
    )


def _memory(result: LiveDriveResult) -> str:
    return (
        f"chunks in service took at most {format_bytes(result.most_bytes)} of"
        f" {format_bytes(result.budget_bytes)};"
        f" {result.given_up} times a chunk was saved and given up, {result.came_back} times one came back"
    )


def _kills(result: LiveDriveResult) -> str:
    kills = result.kills
    return (
        f"the daemon after scan {kills.daemon_at}: back in {format_duration(kills.down_s)}, and"
        f" found {kills.kept} chunks in memory; the mapping program after scan {kills.mapper_at}: its next"
        f" run went on with scan {kills.resumed_at}"
    )


def _compared(result: LiveDriveResult) -> str:
    if result.differing:
        return (
            f"{_spaced(result.differing)} of {_spaced(result.voxels)} voxels on disk are NOT as in a map"
            " without bounds of the same scans"
        )
    return f"all {_spaced(result.voxels)} voxels on disk are as in a map without bounds of the same scans"


def _spaced(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def live_demo_json(result: LiveDriveResult, picture: str, duration_s: float) -> dict[str, object]:
    """Return what ``--json`` prints."""
    kills = result.kills
    return {
        "scans": result.scans,
        "points": result.points,
        "length_m": result.length_m,
        "mapping_s": round(result.mapping_s, 3),
        "chunks": result.chunks,
        "file_bytes": result.file_bytes,
        "budget_bytes": result.budget_bytes,
        "most_bytes": result.most_bytes,
        "given_up": result.given_up,
        "came_back": result.came_back,
        "active": result.active,
        "active_bytes": result.active_bytes,
        "daemon": {"killed_at": kills.daemon_at, "down_s": round(kills.down_s, 3), "chunks": kills.kept},
        "mapper": {"killed_at": kills.mapper_at, "resumed_at": kills.resumed_at},
        "voxels": result.voxels,
        "differing": result.differing,
        "svg": picture,
        "seconds": round(duration_s, 3),
    }
