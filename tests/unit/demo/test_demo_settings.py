# SPDX-License-Identifier: Apache-2.0
"""The demonstration fits itself to the machine it runs on."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from shmmap.demo.demo_town import DemoSettings, fit, free_memory_bytes
from shmmap.errors import ConfigError

GIB = 1 << 30
ROOMY = {"memory_bytes": 64 * GIB, "copies": 8}


def test_with_room_nothing_changes() -> None:
    wanted = DemoSettings()
    settings, budget_bytes = fit(wanted, shm_bytes=64 * GIB, disk_bytes=64 * GIB, **ROOMY)
    assert settings == wanted
    window_points = math.pi * wanted.radius**2 * wanted.density
    assert window_points * 16 < budget_bytes < window_points * 16 * 3


@pytest.mark.parametrize("megabytes", [16, 64, 128])
def test_in_a_container_the_town_is_thinner(megabytes: int) -> None:
    settings, budget_bytes = fit(DemoSettings(), shm_bytes=megabytes << 20, disk_bytes=64 * GIB, **ROOMY)
    assert 2.0 <= settings.density < DemoSettings().density
    assert budget_bytes <= megabytes << 20


def test_little_disk_makes_it_thinner_too() -> None:
    settings, _ = fit(DemoSettings(), shm_bytes=64 * GIB, disk_bytes=100 << 20, **ROOMY)
    ground_points = math.prod(settings.blocks) * 80.0**2 * settings.density
    assert ground_points * 16 < 100 << 20


def test_little_memory_makes_it_thinner_too() -> None:
    """Eight processes with a private copy each have to fit, or the kernel ends one of them."""
    wanted = DemoSettings()
    settings, _ = fit(wanted, shm_bytes=64 * GIB, disk_bytes=64 * GIB, memory_bytes=GIB, copies=8)
    assert 2.0 <= settings.density < wanted.density
    assert 8 * math.pi * wanted.radius**2 * settings.density * 1.65 * 16 < GIB
    fewer, _ = fit(wanted, shm_bytes=64 * GIB, disk_bytes=64 * GIB, memory_bytes=GIB, copies=16)
    assert fewer.density < settings.density


def test_memory_that_processes_can_still_have() -> None:
    text = Path("/proc/meminfo").read_text(encoding="ascii")
    whole = int(text.split("MemTotal:")[1].split()[0]) << 10
    assert 0 < free_memory_bytes() < whole


@pytest.mark.parametrize(("shm_bytes", "disk_bytes"), [(1 << 20, GIB), (GIB, 1 << 20), (0, 0)])
def test_no_room_at_all(shm_bytes: int, disk_bytes: int) -> None:
    with pytest.raises(ConfigError, match="too little room"):
        fit(DemoSettings(), shm_bytes=shm_bytes, disk_bytes=disk_bytes, **ROOMY)
