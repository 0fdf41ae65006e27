# SPDX-License-Identifier: Apache-2.0
"""Where clients will be; which chunks are near them is tested with `Residency`."""

from __future__ import annotations

import pytest

from shmmap.daemon.live.paging.windows import place_ahead


@pytest.mark.parametrize(
    ("here", "passed_s", "found"),
    [
        ((1.0, 0.5, -0.25), 0.5, (5.0, 2.5, -1.25)),
        ((0.0, 0.0, 0.0), 0.1, (0.0, 0.0, 0.0)),
        # a drive that is played back as fast as it can be: no further, and in the same direction
        ((2.0, -1.0, 0.5), 0.001, (12.0, -6.0, 3.0)),
        ((0.0, -100.0, 0.0), 0.1, (0.0, -110.0, 0.0)),
        ((1e-300, 0.0, 0.0), 1e-9, (pytest.approx(0.0), 0.0, 0.0)),
    ],
)
def test_a_client_goes_on_as_it_does(
    here: tuple[float, float, float], passed_s: float, found: tuple[float, float, float]
) -> None:
    assert place_ahead((0.0, 0.0, 0.0), here, passed_s, ahead_s=2.0, most=10.0) == found
