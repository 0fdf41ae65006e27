# SPDX-License-Identifier: Apache-2.0
"""What is set up before the daemon serves."""

from __future__ import annotations

import subprocess
import sys
from typing import Final

import pytest

PROGRAM: Final = """
import sys
from pathlib import Path
from shmmap.daemon.prerequisites import give_back_large_tables

def own_kib():
    status = Path("/proc/self/status").read_text()
    return int(status.split("RssAnon:")[1].split()[0])

if sys.argv[1] == "large":
    give_back_large_tables()
before = own_kib()
table = b"1" * (8 << 20)
del table
table, later = b"1" * (8 << 20), b"1" * (7 << 20)
del table
print(own_kib() - before - 7 * 1024)
"""


@pytest.mark.parametrize(("which", "given_back"), [("large", True), ("none", False)])
def test_a_large_table_goes_back_whatever_was_made_after_it(which: str, given_back: bool) -> None:
    """And the C library alone would keep it, once one of its size has been freed."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, which], stdout=subprocess.PIPE, text=True, check=True, timeout=60.0
    )
    assert (int(done.stdout) < 4096) == given_back
