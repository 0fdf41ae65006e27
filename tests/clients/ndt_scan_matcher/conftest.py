# SPDX-License-Identifier: Apache-2.0
"""Fixtures for scan matching."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.clients.ndt_scan_matcher.scene import TRUTH, scan_from, street


@pytest.fixture(scope="session")
def points() -> NDArray[np.float64]:
    """Return a street's points, (N, 3), metres."""
    made = street()
    made.flags.writeable = False
    return made


@pytest.fixture(scope="session")
def scan() -> NDArray[np.float64]:
    """Return a scan at `TRUTH`, of another sampling of the street: it never holds the map's own points."""
    return scan_from(street(seed=7), TRUTH, 1500)
