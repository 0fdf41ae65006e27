# SPDX-License-Identifier: Apache-2.0
"""Libraries in C that tests load into a program before all others (LD_PRELOAD)."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT

__all__ = ["built_preload"]


def built_preload(name: str, folder: Path) -> Path:
    """Compile ``tests/support/NAME.c`` into a folder; skip the test where there is no compiler."""
    if shutil.which("gcc") is None:
        pytest.skip("gcc is not installed")
    built = folder / f"{name}.so"
    source = ROOT / f"tests/support/{name}.c"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", str(built), str(source), "-ldl"], check=True)
    return built
