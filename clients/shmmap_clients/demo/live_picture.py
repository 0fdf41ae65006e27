# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.demo.live_picture``: drawing program of ``shmmap demo --live``.

Like the picture of ``shmmap-rolling``, but including voxels that are only on disk.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from shmmap_clients.command_line import run_command, write_text

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program and return the exit code."""
    return run_command(
        "shmmap_clients.demo.live_picture",
        "Draw the live map of `shmmap demo --live`.",
        _add_options,
        _run,
        argv,
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--endpoint", required=True, metavar="PATH", help="request socket of the daemon")
    parser.add_argument("--live", required=True, metavar="NAME", help="name of the live map")
    parser.add_argument(
        "--path", type=Path, required=True, metavar="FILE", help="JSON: where the sensor was, metres"
    )
    parser.add_argument("--picture", type=Path, required=True, metavar="FILE", help="SVG")


def _run(args: argparse.Namespace) -> int:
    import shmmap
    from shmmap_clients.rolling_map.live_map import all_voxels, usage_text
    from shmmap_clients.rolling_map.picture import MapContent, map_picture

    path = [(x, y, z) for x, y, z in json.loads(args.path.read_text(encoding="utf-8"))]
    with shmmap.connect(args.endpoint, name="demo picture") as client:
        live = client.live(args.live)
        content = MapContent(
            live.resolution,
            all_voxels(live, "occupied", "all"),
            chunks=live.chunks(saved=True),
            path=path,
            usage=f"in memory: {usage_text(live.status())}",
        )
    note = f"{len(path)} scans, voxels of {live.resolution:g} m; daemon and mapping program were killed"
    write_text(args.picture, map_picture(content, "A drive through a generated town", note))
    return 0


if __name__ == "__main__":
    sys.exit(main())
