# SPDX-License-Identifier: Apache-2.0
"""The journal of a map that is being divided, in which several threads note what they have written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from shmmap.dividing.cell_files import CellFiles
from tests.support.interleaving import interleaved

ROW = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def test_what_is_noted_at_the_same_time_stays_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the system writes less than it was asked to."""
    journal, write = tmp_path / "pieces", os.write
    monkeypatch.setattr(os, "write", lambda fd, data: write(fd, data[: len(data) // 2 + 1]))
    one, other = (1, 1, 1, 1, 1), (2, 2, 2, 2, 2)

    def empty() -> CellFiles:
        journal.unlink(missing_ok=True)
        return CellFiles(str(tmp_path), ROW, "{}_{}".format, journal=str(journal))

    noted = {}
    for pieces in ([one, other], [other, one]):
        files = empty()
        files.written(pieces)
        noted[journal.read_bytes()] = pieces
        files.close()
    orders = []
    for files in interleaved(
        empty, lambda it: it.written([one]), lambda it: it.written([other]), "_journal_lock"
    ):
        orders.append(noted[journal.read_bytes()])
        files.close()
    assert [one, other] in orders
    assert [other, one] in orders
