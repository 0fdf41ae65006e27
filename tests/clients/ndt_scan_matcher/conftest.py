# SPDX-License-Identifier: Apache-2.0
"""Fixtures for scan matching."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.clients.ndt_scan_matcher.scene import street


@pytest.fixture(scope="session")
def points() -> NDArray[np.float64]:
    """Return a street's points, (N, 3), metres."""
    made = street()
    made.flags.writeable = False
    return made
