# SPDX-License-Identifier: Apache-2.0
"""What a long run over clouds made, and what it took."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from shmmap.cli.screens.output import format_bytes, format_duration, print_json, print_pairs

if TYPE_CHECKING:
    from shmmap.dividing.merge import MergedCloud
    from shmmap.origin.map_report import DividedMap

__all__ = ["fields_text", "print_result"]


def fields_text(fields: Sequence[tuple[str, str]]) -> str:
    """Return (name, dtype) pairs for a reader: ``"x:f4 y:f4 z:f4"``."""
    return " ".join(f"{name}:{dtype.lstrip('<|')}" for name, dtype in fields)


def print_result(
    made: DividedMap | MergedCloud, lines: Sequence[tuple[str, str]], *, seconds: float, as_json: bool
) -> None:
    """Print all of ``made`` as JSON, or ``lines`` about it; with the time and the memory it took."""
    from dataclasses import asdict

    from shmmap.dividing.settings import peak_memory_bytes

    peak = peak_memory_bytes()
    if as_json:
        print_json({**asdict(made), "seconds": seconds, "peak_memory_bytes": peak})
    else:
        print_pairs([*lines, ("time", format_duration(seconds)), ("peak memory", format_bytes(peak))])
