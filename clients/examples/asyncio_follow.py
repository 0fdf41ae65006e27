# SPDX-License-Identifier: Apache-2.0
"""Follow a vehicle in asyncio: a window, other requests and events side by side, on one thread.

    python3 asyncio_follow.py X Y           # metres; start; drives 40 m along x, at 10 m/s

One task moves the vehicle, one prints what the window gets, one prints the daemon's loads.  Requests of other
tasks go over the same session, and none waits for another one.
"""

from __future__ import annotations

import asyncio
import sys

import shmmap.aio
import shmmap.events

SPEED = 10.0  # m/s
PERIOD_S = 0.02


async def drive(window: shmmap.aio.MapWindow, x: float, y: float) -> None:
    """Move along x."""
    await window.move_to(x, y, wait=10.0)  # before the start: wait until the first cells are there
    for step in range(200):
        await window.move_to(x + SPEED * PERIOD_S * step, y, vx=SPEED, vy=0.0)
        await asyncio.sleep(PERIOD_S)


async def show_cells(window: shmmap.aio.MapWindow) -> None:
    """Print the cells that are added and removed, until the window is closed."""
    async for update in window:
        print(f"{len(update.added)} cells new, {len(update.removed)} gone, {len(window.cells)} in the window")


async def show_loads() -> None:
    """Print what the daemon loads."""
    async with shmmap.aio.EventStream(since=60.0) as events:
        async for event in events:
            if isinstance(event, shmmap.events.Loaded):
                print(f"the daemon has loaded {event.id}")


async def main() -> None:
    """Follow the vehicle."""
    x, y = map(float, sys.argv[1:3])
    async with shmmap.aio.connect() as client:
        ahead = asyncio.gather(*(client.around(x + step, y, 5.0) for step in range(0, 50, 10)))
        async with shmmap.aio.MapWindow(client, radius=50.0, update_distance=5.0) as window:
            showing = [asyncio.create_task(show_cells(window)), asyncio.create_task(show_loads())]
            await drive(window, x, y)
        showing[1].cancel()
        await asyncio.wait(showing)
        print(f"{sum(cell.points for cells in await ahead for cell in cells)} points at five places ahead")


if __name__ == "__main__":
    asyncio.run(main())
