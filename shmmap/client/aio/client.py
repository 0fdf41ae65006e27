# SPDX-License-Identifier: Apache-2.0
"""`Client` and `connect` of `shmmap.aio`: the requests of `shmmap.Client` as coroutines."""

from __future__ import annotations

import asyncio
import os
import warnings
from collections.abc import Awaitable, Callable, Coroutine, Generator
from functools import partial, wraps
from types import TracebackType
from typing import Any, Concatenate, NoReturn, ParamSpec, TypeVar

import shmmap.client.client as sync
from shmmap.client.aio.driver import LoopDriver, made_in_thread
from shmmap.client.client import CONNECT_S
from shmmap.client.session import Session, Steps
from shmmap.client.session_state import SessionState
from shmmap.errors import warn_program

P = ParamSpec("P")
R = TypeVar("R")


class _Deferred(sync.Deferred):
    """A client whose requests are returned as steps; an incomplete answer is judged after them."""

    verdict: Callable[[], str] | None = None

    def _judge(self, verdict: Callable[[], str]) -> None:
        self.verdict = verdict


def _awaited(
    method: Callable[Concatenate[sync.Client, P], R],
) -> Callable[Concatenate[Client, P], Coroutine[Any, Any, R]]:
    """Return the coroutine function for a request for cells of `shmmap.Client`."""

    @wraps(method)
    async def awaited(self: Client, /, *args: P.args, **options: P.kwargs) -> R:
        deferred = _Deferred(self._session)
        steps: Any = method(deferred, *args, **options)
        answer: R = await self._driver.run(steps)
        if deferred.verdict is not None and (text := await asyncio.to_thread(deferred.verdict)):
            warn_program(text)
        return answer

    return awaited


def _in_thread(
    method: Callable[Concatenate[sync.Client, P], R],
) -> Callable[Concatenate[Client, P], Coroutine[Any, Any, R]]:
    """Return the coroutine function for another request: a thread waits for its replies."""

    @wraps(method)
    async def awaited(self: Client, /, *args: P.args, **options: P.kwargs) -> R:
        self._driver.check_loop()
        return await asyncio.to_thread(method, self._client, *args, **options)

    return awaited


class Client(SessionState):
    """A session with the daemon for the tasks of one event loop; get one from `connect`.

    The coroutines have the parameters, results and errors of the methods of `shmmap.Client` of the same
    names.  Any number may be under way: none waits for another one's answer.  Cells are attached in the loop
    (tens of microseconds each, once); no point is read or copied.

    A task that is cancelled leaves nothing: neither here, nor a place among the waits in the daemon.
    Deadlines, and a restart of the daemon, are as for `shmmap.Client`.  Live maps are that one's alone.

    A client belongs to the loop in which it was connected.  In another loop, or after a fork, its coroutines
    raise `BadRequest`; connect there, too.
    """

    _is_closed = True

    def __init__(self, client: sync.Client) -> None:
        self._client = client
        self._session: Session = client.session
        self._driver = LoopDriver(self._session)
        self._is_closed = False

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def __repr__(self) -> str:
        return f"<aio.Client of {self.endpoint}, map {self.welcome.map_path}>"

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a Client cannot be pickled: it is this process's connection to the daemon. Connect in each"
            " process, shmmap.aio.connect()"
        )

    def __del__(self) -> None:
        if not self._is_closed:
            self._driver.drop()
            warnings.warn(f"{self!r} was not closed", ResourceWarning, stacklevel=2, source=self)

    async def close(self) -> None:
        """End the session; what is under way raises `BadRequest`, attached cells stay readable."""
        if not self._is_closed:
            self._driver.check_loop()
            self._is_closed = True
            self._driver.stop()
            await asyncio.shield(self.loop.run_in_executor(None, self._client.close))

    # --- for windows --------------------------------------------------------------------------------

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The event loop of the client."""
        return self._driver.loop

    def check_loop(self) -> None:
        """Refuse another event loop, and a forked child."""
        self._driver.check_loop()

    def call(self, work: Callable[..., object]) -> None:
        """Have the loop call something, from any thread."""
        self._driver.call(work)

    async def run(self, steps: Steps[R]) -> R:
        """Send requests one after another, and return their answer."""
        return await self._driver.run(steps)

    # --- requests -----------------------------------------------------------------------------------

    around = _awaited(sync.Client.around)
    area = _awaited(sync.Client.area)
    points_around = _awaited(sync.Client.points_around)
    differential = _awaited(sync.Client.differential)
    selected = _awaited(sync.Client.selected)

    metadata = _in_thread(sync.Client.metadata)
    live_maps = _in_thread(sync.Client.live_maps)
    stats = _in_thread(sync.Client.stats)
    list_cells = _in_thread(sync.Client.list_cells)
    show = _in_thread(sync.Client.show)
    reload = _in_thread(sync.Client.reload)
    evict = _in_thread(sync.Client.evict)
    pin = _in_thread(sync.Client.pin)
    unpin = _in_thread(sync.Client.unpin)
    release = _in_thread(sync.Client.release)


class Connecting(Awaitable[Client]):
    """What `connect` returns: await it, or enter it with ``async with``."""

    def __init__(self, begin: Callable[[], sync.Client]) -> None:
        self._begin = begin
        self._client: Client | None = None

    def __await__(self) -> Generator[Any, Any, Client]:
        return self._connect().__await__()

    async def _connect(self) -> Client:
        return Client(await made_in_thread(self._begin))

    async def __aenter__(self) -> Client:
        self._client = await self._connect()
        return self._client

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._client is not None:
            await self._client.close()


def connect(
    endpoint: str | os.PathLike[str] | None = None,
    *,
    instance: str | None = None,
    timeout: float = 5.0,
    connect_timeout: float = CONNECT_S,
    name: str = "",
    shm_dir: str | None = None,
) -> Connecting:
    """Find the daemon and begin a session, which belongs to the running event loop.

    ``async with shmmap.aio.connect() as client:``; or ``client = await shmmap.aio.connect()``, and at the end
    ``await client.close()``.  Parameters and errors are those of `shmmap.connect`.
    """
    return Connecting(
        partial(
            sync.connect,
            endpoint,
            instance=instance,
            timeout=timeout,
            connect_timeout=connect_timeout,
            name=name,
            shm_dir=shm_dir,
        )
    )
