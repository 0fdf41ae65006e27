# SPDX-License-Identifier: Apache-2.0
"""Format memory, time and coordinates for readers, the same way in all screens, logs and messages."""

from __future__ import annotations

from datetime import datetime, timezone


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: ``"1 cell"``, ``"2,400 cells"``."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def format_bytes(count: float) -> str:
    """Return bytes for a reader, ``"4.1 KiB"`` or ``"103 MiB"``; powers of 1024, as ``--budget``."""
    value = float(count)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if abs(value) < 1023.5 or unit == "GiB":
            break
        value /= 1024.0
    digits = 0 if unit == "B" or abs(value) >= 99.95 else 1
    return f"{value:.{digits}f} {unit}"


def format_duration(duration_s: float) -> str:
    """Return a time span for a reader: ``"12 us"``, ``"3.4 ms"``, ``"5.0 s"``, ``"3 min"``, ``"2 h"``."""
    if duration_s < 0.9995e-3:
        return f"{duration_s * 1e6:.0f} us"
    if duration_s < 0.9995:
        return f"{duration_s * 1e3:.1f} ms"
    if duration_s < 119.5:
        return f"{duration_s:.1f} s"
    if duration_s < 7170:
        return f"{duration_s / 60:.0f} min"
    if duration_s < 2 * 86400:
        return f"{duration_s / 3600:.0f} h"
    return f"{duration_s / 86400:.0f} d"


def format_utc(unix_s: float, *, seconds: bool = False) -> str:
    """Return a moment, Unix time, as text: ``"2026-01-31 23:59 UTC"``."""
    form = "%Y-%m-%d %H:%M:%S UTC" if seconds else "%Y-%m-%d %H:%M UTC"
    return datetime.fromtimestamp(unix_s, timezone.utc).strftime(form)


def format_metres(value: float) -> str:
    """Return a coordinate or a length in metres for a reader, to the millimetre: ``"5403000.25"``."""
    return f"{round(value, 3) + 0.0:.12g}"
