# SPDX-License-Identifier: Apache-2.0
"""Areas and places that cannot be sent are refused before they are."""

from __future__ import annotations

import math

import pytest

import shmmap
from shmmap.client.live.live_map import LiveMap, _area
from shmmap.errors import BadRequest
from shmmap.protocol.areas import SphereMessage


@pytest.mark.parametrize(
    "numbers",
    [
        (0, 0, 0, 1.4e154), (0, 0, 0, 1.7e308), (0, 0, 0, 1e150), (1e155, 0, 0, 1), (0, -1.7e308, 0, 1),
        (0, 0, 10**400, 1), (0, 0, 0, 10**400), (math.nan, 0, 0, 1), (0, 0, math.inf, 1), (0, 0, 0, math.inf),
        (0, 0, 0, -1e-9), (0, 0, 0, math.nan),
    ],
)  # fmt: skip
def test_spheres_that_make_no_sense(numbers: tuple[float, float, float, float]) -> None:
    with pytest.raises(BadRequest, match="finite"):
        _area(shmmap.live.Sphere(*numbers))


def test_spheres_that_do() -> None:
    assert _area(shmmap.live.Sphere(1, -2, 3, 0)) == SphereMessage(1.0, -2.0, 3.0, 0.0)
    assert _area(shmmap.live.Sphere(0, 0, 0, 9e149)) == SphereMessage(0.0, 0.0, 0.0, 9e149)
    assert _area(None) is None


def test_a_place_beyond_all_floats() -> None:
    with pytest.raises(BadRequest, match="not finite"):
        LiveMap.move_to(object.__new__(LiveMap), 10**400, 0, 0)
