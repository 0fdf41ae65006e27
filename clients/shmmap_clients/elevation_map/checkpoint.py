# SPDX-License-Identifier: Apache-2.0
"""What an interrupted build needs to continue: how far it was, and the rows that wait at seams."""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from shmmap.formats.npz_writer import write_npz
from shmmap_clients.elevation_map.seams import Columns, Seams

__all__ = ["Checkpoint", "Journal"]


@dataclass(slots=True)
class Checkpoint:
    """Cells done, in order; rows read; points outside their cell; columns that had a point."""

    done: int = 0
    rows: int = 0
    stray: int = 0
    occupied: int = 0


class Journal:
    """Keeps the latest checkpoint of a build in its directory.

    Heights and ``seams-N.npz`` are forced to the disk first, then ``state.json`` with N appears by rename:
    whenever a build or its machine dies, the state speaks of what is there whole.  Columns finished after a
    checkpoint are made again, with the same heights.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def write(self, state: Checkpoint, seams: Seams) -> None:
        """Replace the checkpoint."""
        arrays = {}
        for number, rows in seams.waiting.items():
            arrays[f"i{number}"], arrays[f"j{number}"] = rows.i, rows.j
            arrays[f"values{number}"] = rows.values
        with open(self._directory / f"seams-{state.done}.npz", "wb") as file:
            write_npz(file, arrays)
            file.flush()
            os.fsync(file.fileno())
        with open(self._directory / "heights", "rb") as heights:
            os.fsync(heights.fileno())
        interim = self._directory / "state.json.tmp"
        interim.write_text(json.dumps(asdict(state)), encoding="utf-8")
        interim.replace(self._directory / "state.json")
        for path in self._directory.glob("seams-*.npz"):
            if path.name != f"seams-{state.done}.npz":
                path.unlink()

    def read(self, seams: Seams) -> Checkpoint | None:
        """Return the latest checkpoint and fill ``seams`` from it; None where there is no good one."""
        try:
            state = Checkpoint(**json.loads((self._directory / "state.json").read_text(encoding="utf-8")))
            with np.load(self._directory / f"seams-{state.done}.npz", allow_pickle=False) as archive:
                waiting = {
                    int(name[1:]): Columns(
                        archive[name], archive[f"j{name[1:]}"], archive[f"values{name[1:]}"]
                    )
                    for name in archive.files
                    if name.startswith("i")
                }
        except (OSError, ValueError, TypeError, KeyError, zipfile.BadZipFile):
            return None
        if not (self._directory / "heights").exists():
            return None
        seams.waiting.update(waiting)
        return state
