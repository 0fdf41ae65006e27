# SPDX-License-Identifier: Apache-2.0
"""Waits until a disk tier of this process has trimmed what it keeps."""

from __future__ import annotations

import threading

__all__ = ["wait_for_trimming"]


def wait_for_trimming() -> None:
    """Join the threads that trim."""
    for thread in threading.enumerate():
        if thread.name == "trim":
            thread.join()
