# SPDX-License-Identifier: Apache-2.0
"""The node of ``tests/support/autoware_node.cpp``, compiled with its own message types or with ROS 2's."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT
from tests.support.rosidl_messages import generated_messages

__all__ = ["NODE", "TYPES", "compiled_here", "compiled_node"]

TYPES: Final = ("plain", "generated")
NODE: Final = ROOT / "tests" / "support" / "autoware_node.cpp"


def compiled_here(source: Path, program: Path, options: Sequence[str] = ()) -> Path:
    """Compile a program with every warning an error, and the sanitizers of addresses and undefined behaviour."""
    checks = ["-std=c++17", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", *FLAGS]
    subprocess.run(["g++", *checks, *options, str(source), "-o", str(program), "-pthread"], check=True)
    return program


def compiled_node(types: str, folder: Path) -> Path | None:
    """Compile the node with these types; None where their generator is missing."""
    options: list[str] | None = []
    if types == "generated":
        options = generated_messages(folder)
        if options is None:
            return None
        options = ["-DSHMMAP_GENERATED", *options]
    return compiled_here(NODE, folder / "node", options)
