# SPDX-License-Identifier: Apache-2.0
"""Drives beside a slow origin as one SVG."""

from __future__ import annotations

from tests.benchmarks.slow_origin_model import Outages
from tests.benchmarks.slow_origin_run import Counts

__all__ = ["drive_picture"]


def drive_picture(drives: dict[str, Counts], outages: Outages) -> str:
    """x"""
    return ""
