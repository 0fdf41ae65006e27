# SPDX-License-Identifier: Apache-2.0
"""The node of ``tests/support/autoware_node.cpp``, compiled with its own message types or with ROS 2's."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Final

from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT
from tests.support.rosidl_messages import generated_messages

__all__ = ["NODE", "TYPES", "compiled_with"]

TYPES: Final = ("plain", "generated")
NODE: Final = ROOT / "tests" / "support" / "autoware_node.cpp"


def compiled_with(types: str, source: Path, folder: Path) -> Path | None:
    """Compile a program with these types; None where their generator is missing.

    Every warning is an error; the sanitizers of addresses and of undefined behaviour are part of it.
    """
    options: list[str] = []
    if types == "generated":
        found = generated_messages(folder)
        if found is None:
            return None
        options = ["-DSHMMAP_GENERATED", *found]
    program = folder / source.stem
    checks = ["-std=c++17", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", *FLAGS]
    subprocess.run(["g++", *checks, *options, str(source), "-o", str(program), "-pthread"], check=True)
    return program
