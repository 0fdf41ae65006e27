# SPDX-License-Identifier: Apache-2.0
"""`EventStream` of `shmmap.aio`: the daemon's events as an asynchronous iterator."""

from __future__ import annotations

import asyncio
import contextlib
import os
import warnings
from collections import deque
from functools import partial
from types import TracebackType

import shmmap.client.event_stream as sync
from shmmap.client.aio.driver import made_in_thread
from shmmap.client.event_stream import Happening
from shmmap.errors import BadRequest


class EventStream:
    """The daemon's events, in order: `shmmap.events.EventStream` for asyncio.

    ::

        async with shmmap.aio.EventStream(since=60) as stream:
            async for event in stream:
                print(event)

    The loop watches the socket; a thread of its executor takes what has come, and fetches what was missed.
    One task may iterate; a task that is cancelled loses no event.

    Parameters
    ----------
    endpoint, instance, since, name, timeout
        As for `shmmap.events.EventStream`.

    Raises
    ------
    DaemonUnreachable, ProtocolMismatch
        When it is entered, as `shmmap.events.EventStream`.
    """

    _stream: sync.EventStream | None = None
    _file = -1

    def __init__(
        self,
        endpoint: str | os.PathLike[str] | None = None,
        *,
        instance: str | None = None,
        since: float | None = None,
        name: str = "",
        timeout: float = 5.0,
    ) -> None:
        self._make = partial(
            sync.EventStream, endpoint, instance=instance, since=since, name=name, timeout=timeout
        )
        self._ready: deque[Happening] = deque()
        self._taking: asyncio.Future[None] | None = None
        self._signal: asyncio.Future[None] | None = None

    async def __aenter__(self) -> EventStream:
        self._loop = asyncio.get_running_loop()
        stream = await made_in_thread(self._make)
        self._file, self._stream = stream.descriptor(), stream
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def __del__(self) -> None:
        if self._stream is not None:
            os.close(self._file)
            warnings.warn(f"{self!r} was not closed", ResourceWarning, stacklevel=2, source=self)

    async def close(self) -> None:
        """End the subscription, and the iteration of a task that waits for an event."""
        if self._stream is None:
            return
        self._check_loop()
        stream, self._stream = self._stream, None
        try:
            if self._taking is not None:
                self._signalled()
                await asyncio.wait([self._taking])
        finally:
            self._loop.remove_reader(self._file)
            os.close(self._file)
            closing = self._loop.run_in_executor(None, stream.close)
        await asyncio.shield(closing)

    def __aiter__(self) -> EventStream:
        return self

    async def __anext__(self) -> Happening:
        """Return the next event, or `MissedEvents`; wait for it without bound.

        Raises
        ------
        BadRequest
            The stream was not entered, or in another event loop.
        """
        self._check_loop()
        while not self._ready:
            if self._stream is None:
                raise StopAsyncIteration
            if self._taking is None or self._taking.done():
                self._taking = self._loop.create_task(self._take(self._stream))
            await asyncio.shield(self._taking)  # it goes on where this is cancelled
        return self._ready.popleft()

    def _check_loop(self) -> None:
        if self._file < 0 or asyncio.get_running_loop() is not self._loop:
            raise BadRequest(
                "this event stream was not entered in this event loop",
                hint="async with shmmap.aio.EventStream() as stream",
            )

    async def _take(self, stream: sync.EventStream) -> None:
        """Take what has come, as soon as that is anything."""
        with contextlib.suppress(BadRequest):  # closed meanwhile
            await asyncio.to_thread(self._take_all, stream)
            while not self._ready and self._stream is stream:
                self._signal = self._loop.create_future()
                self._loop.add_reader(self._file, self._signalled)
                try:
                    await self._signal
                finally:
                    self._loop.remove_reader(self._file)
                await asyncio.to_thread(self._take_all, stream)

    def _signalled(self) -> None:
        if self._signal is not None and not self._signal.done():
            self._signal.set_result(None)

    def _take_all(self, stream: sync.EventStream) -> None:
        while (happening := stream.next(0)) is not None:
            self._ready.append(happening)
