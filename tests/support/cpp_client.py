# SPDX-License-Identifier: Apache-2.0
"""The client of ``tests/support/cpp_client.cpp``: compiled with all checks there are, asked by lines."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Final

from tests.support.daemon_process import ROOT

__all__ = ["FLAGS", "INCLUDE", "CppClient", "compiled"]

INCLUDE: Final = ROOT / "clients" / "cpp" / "include"
SOURCE: Final = ROOT / "tests" / "support" / "cpp_client.cpp"
FLAGS: Final = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wpedantic", "-Werror", f"-I{INCLUDE}")


def compiled(folder: Path, *, compiler: str = "g++", standard: str = "c++17") -> Path:
    """Compile the client, with the sanitizers of addresses and of undefined behaviour."""
    program = folder / f"cpp_client.{compiler}.{standard}"
    subprocess.run(
        [
            compiler, f"-std={standard}", "-O1", "-g", "-fsanitize=address,undefined",
            "-fno-sanitize-recover=all", *FLAGS, str(SOURCE), "-o", str(program),
        ],
        check=True,
    )  # fmt: skip
    return program


class CppClient:
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
        self._process.stdin.write("\t".join(map(str, words)) + "\n")
        self._process.stdin.flush()
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
