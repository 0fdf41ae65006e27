# SPDX-License-Identifier: Apache-2.0
"""Clients that only work: they walk over the map, and ask for cells that are not in memory."""

from __future__ import annotations

import itertools
import time
from typing import Final

from tests.benchmarks.hostile.actors import Orders
from tests.support.raw_client import RawClient

__all__ = ["fills", "walks_cold"]

STEP_M: Final = 140.0
INSIDE_M: Final = STEP_M - 21.0
"""So wide a box touches 6 cells of 20 m, and the next one none of them."""
TIMEOUT_S: Final = 900.0


def places(x_m: tuple[float, float], y_m: tuple[float, float]) -> list[tuple[float, float]]:
    """Corners of the steps of a walk over a rectangle of the map, row by row."""
    xs, ys = (
        [low + 1.0 + STEP_M * number for number in range(max(1, int((high - low) // STEP_M)))]
        for low, high in (x_m, y_m)
    )
    return [(x, y) for y in ys for x in xs]


def walks_cold(
    orders: Orders,
    endpoint: str,
    seconds: float,
    x_m: tuple[float, float],
    y_m: tuple[float, float],
    once: bool = False,
) -> tuple[int, float]:
    """Walk over a rectangle, ask for 36 cells at each step, and let go of them.

    Parameters
    ----------
    once
        Do not begin again at its end, where cells may still be in memory.

    Returns
    -------
    int
        Cells that were loaded meanwhile: what is still in memory from the last time does not count.
    float
        Seconds it took, less than ``seconds`` if it is told to end.
    """
    with RawClient(endpoint, name="walks", timeout=TIMEOUT_S) as client:
        before = client.ask("stats")[4]["loads_finished"]
        begin_s = time.monotonic()
        way = places(x_m, y_m)
        for x, y in way if once else itertools.cycle(way):
            if time.monotonic() - begin_s > seconds or not orders.go_on():
                break
            client.area(["box", x, y, x + INSIDE_M, y + INSIDE_M, None, None], wait=60.0)
            client.release()
        took_s = time.monotonic() - begin_s
        return client.ask("stats")[4]["loads_finished"] - before, took_s


def fills(orders: Orders, endpoint: str, side: int, most: int) -> int:
    """Have the cells of a map of ``side`` x ``side`` loaded, row by row, until so many came."""
    came = 0
    with RawClient(endpoint, name="fills", timeout=TIMEOUT_S) as client:
        for row in range(side):
            columns = min(side, most - came)
            if columns <= 0:
                break
            y = 20.0 * row + 1.0
            reply = client.area(["box", 1.0, y, 20.0 * columns - 1.0, y + 1.0, None, None], wait=600.0)
            came += len(reply.cells)
            client.release()
    return came
