# SPDX-License-Identifier: Apache-2.0
"""The demonstration fits itself to the machine it runs on."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from shmmap.demo.demo_town import DemoSettings, fit, free_memory_bytes
from shmmap.errors import ConfigError

GIB = 1 << 30
PLENTY = {"shm_bytes": 64 * GIB, "disk_bytes": 64 * GIB, "memory_bytes": 64 * GIB, "copies": 8}


def test_with_room_nothing_changes() -> None:
    wanted = DemoSettings()
    settings, budget_bytes = fit(wanted, **PLENTY)
    assert settings == wanted
    window_points = math.pi * wanted.radius**2 * wanted.density
    assert window_points * 16 < budget_bytes < window_points * 16 * 3


@pytest.mark.parametrize(
    "scarce",
    [
        *({"shm_bytes": megabytes << 20} for megabytes in (16, 64, 128)),  # as in a container
        {"disk_bytes": 100 << 20},
        {"memory_bytes": GIB},
        {"memory_bytes": GIB, "copies": 16},
    ],
    ids=str,
)
def test_where_room_is_scarce_the_town_is_thinner(scarce: dict[str, int]) -> None:
    """Private copies of all processes have to fit, too, or the kernel ends one of them."""
    room = PLENTY | scarce
    settings, budget_bytes = fit(DemoSettings(), **room)
    assert 2.0 <= settings.density < DemoSettings().density
    assert budget_bytes <= room["shm_bytes"]
    assert math.prod(settings.blocks) * 80.0**2 * settings.density * 16 < room["disk_bytes"]
    window_bytes = math.pi * settings.radius**2 * settings.density * 1.65 * 16
    assert room["copies"] * window_bytes < room["memory_bytes"]


def test_memory_that_processes_can_still_have() -> None:
    text = Path("/proc/meminfo").read_text(encoding="ascii")
    whole = int(text.split("MemTotal:")[1].split()[0]) << 10
    assert 0 < free_memory_bytes() < whole


@pytest.mark.parametrize(("shm_bytes", "disk_bytes"), [(1 << 20, GIB), (GIB, 1 << 20), (0, 0)])
def test_no_room_at_all(shm_bytes: int, disk_bytes: int) -> None:
    with pytest.raises(ConfigError, match="too little room"):
        fit(DemoSettings(), **(PLENTY | {"shm_bytes": shm_bytes, "disk_bytes": disk_bytes}))
