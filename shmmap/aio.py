# SPDX-License-Identifier: Apache-2.0
"""The map for programs of asyncio: many requests at once on one session, windows and events.

::

    import asyncio
    import shmmap.aio

    async def main():
        async with shmmap.aio.connect() as client:
            cells = await client.around(x, y, radius=50)
            many = await asyncio.gather(*(client.around(x, y, radius=20) for x, y in places))

    asyncio.run(main())

A window is moved in one task and followed in others; `EventStream` has what happens in the daemon:

::

    async with shmmap.aio.MapWindow(client, radius=50) as window:
        await window.move_to(x, y, wait=10)
        async for update in window:
            print(len(update.added), "cells new")

    async with shmmap.aio.EventStream() as stream:
        async for event in stream:
            print(event)

The coroutines of `Client` have the parameters, results and errors of `shmmap.Client`.  Cells, areas, errors
and the kinds of events are those of `shmmap` and `shmmap.events`.  A wait may be cut short as any other in
asyncio, ``await asyncio.wait_for(client.around(x, y), 0.1)``: what is cancelled leaves nothing.

Requests for cells, and windows, are sent and received by the event loop, asyncio's or another with
``add_reader`` (uvloop); no thread is in between.  Connecting, closing, taking events, and requests about the
map and the daemon (`Client.stats`, `Client.metadata`) use threads of the loop's executor.
"""

from __future__ import annotations

from shmmap.client.aio.client import Client, Connecting, connect
from shmmap.client.aio.events import EventStream
from shmmap.client.aio.window import MapWindow

__all__ = ["Client", "Connecting", "EventStream", "MapWindow", "connect"]
