# SPDX-License-Identifier: Apache-2.0
"""Report that kernels compile, which takes seconds, once on a machine; costs next to nothing to import."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

__all__ = ["compiling", "report_to"]

_KERNEL: Final = b"\n@compiled("

_reports: list[Callable[[str, int, int], None]] = []
_numbers: dict[Path, int] = {}


def report_to(report: Callable[[str, int, int], None]) -> None:
    """Have this process call a function before it compiles a kernel.

    Its arguments are the name of the kernel's package, the kernel's number among those of the package that
    this process compiles, and how many kernels the package has.
    """
    _reports[:] = [report]


def compiling(folder: Path) -> None:
    """Report that a kernel of the package in a folder is compiled now."""
    number = _numbers[folder] = _numbers.get(folder, 0) + 1
    if not _reports:
        return
    try:
        count = sum(path.read_bytes().count(_KERNEL) for path in folder.glob("*.py"))
    except OSError:
        count = number
    for report in _reports:
        report(folder.name, number, max(number, count))
