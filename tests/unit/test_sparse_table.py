# SPDX-License-Identifier: Apache-2.0
"""Tables of which few rows are written take the memory of those rows, as few pages as can be."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np
import pytest

from shmmap.large_tables import sparse_zeros

ROWS = 1 << 23
WRITTEN = 64


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE


@pytest.mark.parametrize(
    ("shape", "dtype"), [(0, np.uint64), (3, np.bool_), ((7, 2), np.float64), ((1 << 20, 3), np.int32)]
)
def test_it_is_an_array_of_zeros(shape: int | tuple[int, ...], dtype: type[np.generic]) -> None:
    table = sparse_zeros(shape, dtype)
    right = np.zeros(shape, dtype)
    assert table.dtype == right.dtype
    assert np.array_equal(table, right)
    table[...] = 1
    assert table.all()
    assert table.flags.c_contiguous


def test_a_row_here_and_there_takes_no_more_than_a_page_each() -> None:
    before = resident_bytes()
    table = sparse_zeros(ROWS, np.uint64)
    table[:: ROWS // WRITTEN] = 7
    assert int(table.sum()) == 7 * WRITTEN
    assert table[1] == 0
    assert resident_bytes() - before < table.nbytes / 2


def test_its_memory_goes_with_it() -> None:
    table = sparse_zeros(ROWS, np.uint64)
    table[...] = 1
    before = resident_bytes()
    del table
    assert before - resident_bytes() > 0.9 * 8 * ROWS
