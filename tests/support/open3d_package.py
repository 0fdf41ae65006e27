# SPDX-License-Identifier: Apache-2.0
"""Open3D, where its package and the libraries of the system that it needs are there."""

from __future__ import annotations

from typing import Any

import pytest

__all__ = ["open3d_or_skip"]


def open3d_or_skip() -> Any:
    """Return Open3D's module; skip the test where it cannot be loaded."""
    reason = "Open3D, or one of libegl1 libgl1 libx11-6 libusb-1.0-0 that it needs, is missing"
    return pytest.importorskip("open3d", reason=reason, exc_type=ImportError)
