# SPDX-License-Identifier: Apache-2.0
"""The node of ``tests/support/autoware_node.cpp``, compiled with its own message types or with ROS 2's."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Final

from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT
from tests.support.rosidl_messages import GENERATORS, generated_messages

__all__ = ["NODE", "TYPES", "AutowareNode", "compiled_with"]

TYPES: Final = ("generated",) if GENERATORS.is_dir() else ("plain",)
"""The program's own types where ROS 2's generator is missing."""
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
    checks = ["-std=c++17", "-Og", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", *FLAGS]
    subprocess.run(["g++", *checks, *options, str(source), "-o", str(program), "-pthread"], check=True)
    return program


class AutowareNode:
    """One such process."""

    def __init__(self, program: Path) -> None:
        self._process = subprocess.Popen(
            [program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**os.environ, "ASAN_OPTIONS": "detect_leaks=1"},
        )  # fmt: skip

    def ask(self, *words: object) -> list[list[str]]:
        """Say something; returns the lines of the answer, each as its words."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(*words, sep="\t", file=self._process.stdin, flush=True)
        found: list[list[str]] = []
        for line in self._process.stdout:
            if line == "end\n":
                return found
            found.append(line.removesuffix("\n").split("\t"))
        raise AssertionError(f"it ended with {self._process.wait()}")

    def close(self) -> int:
        """Have it end; returns its exit code: not 0 where a sanitizer found something."""
        self._process.communicate()
        return self._process.returncode
