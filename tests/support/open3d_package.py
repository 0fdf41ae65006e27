# SPDX-License-Identifier: Apache-2.0
"""Open3D, where its package and the libraries of the system that it needs are there."""

from __future__ import annotations

from typing import Any

import pytest

from shmmap.layers.selections import SYSTEM_PACKAGES

__all__ = ["open3d_or_skip"]


def open3d_or_skip() -> Any:
    """Return Open3D's module; skip the test where it cannot be loaded."""
    reason = f"Open3D, or one of {' '.join(SYSTEM_PACKAGES)} that it needs, is missing"
    return pytest.importorskip("open3d", reason=reason, exc_type=ImportError)
