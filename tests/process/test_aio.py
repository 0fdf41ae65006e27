# SPDX-License-Identifier: Apache-2.0
"""The client for asyncio: many tasks on one session; cancelled, over the daemon's end, in other loops."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import shmmap
import shmmap.aio
from shmmap.errors import BadRequest, DaemonUnreachable, LoadTimeout, NoAnswer, UnknownCell
from shmmap.events import Epoch, Loaded
from tests.process.conftest import COLD
from tests.support.daemon_process import DaemonProcess, Deadline, standing_still
from tests.support.divided_map import DividedMap
from tests.support.segment_reader import names

Main = Callable[[shmmap.aio.Client], Coroutine[Any, Any, Any]]
LONG_S = 60.0


@pytest.fixture
def run(one: DaemonProcess) -> Callable[[Main], Any]:
    """Run a coroutine function with a client."""

    async def with_client(main: Main) -> Any:
        async with shmmap.aio.connect(one.endpoint, timeout=LONG_S) as client:
            answer = await main(client)
            assert not table_of(client).is_busy, "something is left"
            return answer

    return lambda main: asyncio.run(with_client(main))


def exchange_of(client: shmmap.aio.Client) -> Any:
    assert client.session._connection is not None
    return client.session._connection._exchange


def table_of(client: shmmap.aio.Client) -> Any:
    return exchange_of(client).table


async def until(done: Callable[[], object]) -> None:
    deadline = Deadline()
    while deadline(not done()):
        await asyncio.sleep(0)


def test_answers_are_those_of_the_client(one: DaemonProcess, run: Callable[[Main], Any]) -> None:
    area, circle = shmmap.Box(-5, -5, 5, 5), shmmap.Circle(0, 0, 30)
    with shmmap.connect(one.endpoint) as sync:
        expected = sync.around(0, 0, 30)
        held = [cell.id for cell in expected[:3]]

        async def main(client: shmmap.aio.Client) -> None:
            for coroutine, answer in (
                (client.around(0, 0, 30), expected),
                (client.area(area, pose=(0, 0)), sync.area(area)),
                (client.differential(circle, held), sync.differential(circle, held)),
                (client.selected(held[::-1]), sync.selected(held[::-1])),
            ):
                found = await coroutine
                assert [(cell.id, cell.version) for cell in found] == [
                    (cell.id, cell.version) for cell in answer
                ]
                assert all(
                    np.array_equal(a.xyz, b.xyz) for a, b in zip(found.cells, answer.cells, strict=True)
                )
            points = await client.points_around(0, 0, 20)
            assert np.array_equal(points.gather(), sync.points_around(0, 0, 20).gather())
            assert points.covered
            assert list(await client.metadata()) == list(sync.metadata())
            assert (await client.stats()).epoch == client.epoch == sync.epoch
            assert (await client.show(held[0])).id == held[0]

        run(main)


def test_errors(one: DaemonProcess, run: Callable[[Main], Any]) -> None:
    async def main(client: shmmap.aio.Client) -> None:
        with pytest.raises(BadRequest, match="radius"):
            await client.around(0, 0, -1)
        with pytest.raises(BadRequest, match="layer"):
            await client.around(0, 0, 1, layers="none")
        with pytest.raises(UnknownCell, match="no cell"):
            await client.around(1e6, 0, 1, strict=True)
        with pytest.warns(shmmap.ShmmapWarning, match="no cell") as said:
            assert not len(await client.around(1e6, 0, 1))
        with pytest.warns(shmmap.ShmmapWarning, match="no cell") as of_a_task:
            await asyncio.create_task(client.around(1e6, 0, 1))  # as `wait_for` before Python 3.12
        assert said[0].filename == of_a_task[0].filename == __file__
        with pytest.raises(UnknownCell):
            await client.show("none")
        with standing_still(one), pytest.raises(LoadTimeout):
            await client.around(*COLD, wait=0.1, strict=True)
        with pytest.raises(TypeError, match="pickled"):
            client.__reduce__()

    run(main)

    async def nowhere() -> None:
        with pytest.raises(DaemonUnreachable):
            async with shmmap.aio.connect("/nowhere/x.sock"):
                pass

    asyncio.run(nowhere())


def test_a_loop_that_goes_on_in_another_thread(one: DaemonProcess, divided_map: DividedMap) -> None:
    """asyncio's debug mode refuses what is not safe from the thread that the loop began in."""
    loop = asyncio.new_event_loop()
    loop.set_debug(True)
    called, ended = threading.Event(), asyncio.Event()

    async def connected() -> shmmap.aio.Client:
        return await shmmap.aio.connect(one.endpoint, timeout=LONG_S)

    async def others() -> None:
        assert names(await client.around(0, 0, 5)) == divided_map.in_circle(0, 0, 5)
        await ended.wait()
        await client.close()

    client = loop.run_until_complete(connected())
    with ThreadPoolExecutor(1) as pool:
        work = pool.submit(loop.run_until_complete, others())
        client.call(called.set)
        assert called.wait(LONG_S)
        client.call(ended.set)
        work.result(LONG_S)
    loop.run_until_complete(loop.shutdown_default_executor())
    loop.close()


def test_a_hundred_tasks(run: Callable[[Main], Any], divided_map: DividedMap) -> None:
    async def main(client: shmmap.aio.Client) -> None:
        async def task(number: int) -> None:
            for step in range(5):
                where = (float(number % 10 * 10 - 45), float(step * 20 - 45), 5.0)
                assert names(await client.around(*where, wait=LONG_S)) == divided_map.in_circle(*where)

        await asyncio.gather(*(task(number) for number in range(100)))

    run(main)


def test_warm_beside_those_that_wait(one: DaemonProcess, run: Callable[[Main], Any]) -> None:
    """More wait than the daemon has places for; each gets its answer, when it is there."""

    async def main(client: shmmap.aio.Client) -> None:
        with standing_still(one):
            waiting = [asyncio.create_task(client.around(*COLD, wait=LONG_S)) for _ in range(70)]
            await until(lambda: len(table_of(client)._held) == 6)
            for _ in range(5):
                assert (await client.around(0, 0, 5)).complete
                assert (await client.stats()).epoch == client.epoch
            assert not any(task.done() for task in waiting)
        for cells in await asyncio.gather(*waiting):
            assert names(cells) == ["40_40.pcd"]

    run(main)


def test_cancelled(one: DaemonProcess, run: Callable[[Main], Any]) -> None:
    """No entry here and no place there is left, however the wait ends."""

    async def main(client: shmmap.aio.Client) -> None:
        with standing_still(one):
            for cancelled in (1, 300):
                tasks = [asyncio.create_task(client.around(*COLD, wait=600)) for _ in range(cancelled)]
                await until(lambda count=cancelled: len(table_of(client).entries) == count)  # type: ignore[misc]
                for task in tasks:
                    task.cancel()
                await asyncio.wait(tasks)
                await until(lambda: not table_of(client).is_busy)
            with pytest.raises(asyncio.TimeoutError):
                await asyncio.wait_for(client.around(*COLD, wait=600), 0.05)
            unsent = asyncio.create_task(client.around(*COLD, wait=600))
            await asyncio.sleep(0)
            unsent.cancel()
            more = [asyncio.create_task(client.around(*COLD, wait=600)) for _ in range(64)]
            await until(lambda: len(table_of(client)._waiting) == 64)
            await client.stats()
            assert (len(table_of(client)._held), len(table_of(client)._waiting)) == (0, 64)
        for cells in await asyncio.gather(*more):
            assert names(cells) == ["40_40.pcd"]

    run(main)


def test_a_late_answer_does_not_keep_the_loop_busy(one: DaemonProcess, run: Callable[[Main], Any]) -> None:
    """What answers a request that was cancelled is taken from the socket, too."""

    async def main(client: shmmap.aio.Client) -> None:
        loop: Any = asyncio.get_running_loop()
        one.send(signal.SIGSTOP)  # else one may be answered before it is cancelled
        tasks = [asyncio.create_task(client.around(0, 0, 5)) for _ in range(20)]
        await until(lambda: len(table_of(client).entries) == 20)
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        one.send(signal.SIGCONT)
        await client.stats()  # its answer comes after theirs
        waits: list[float | None] = []
        select = loop._selector.select

        def counted(timeout: float | None) -> Any:
            waits.append(timeout)
            return select(timeout)

        loop._selector.select = counted
        await asyncio.sleep(0.2)
        assert len(waits) < 10

    run(main)


def test_a_daemon_that_is_killed_while_many_wait(one: DaemonProcess, divided_map: DividedMap) -> None:
    async def main() -> None:
        async with shmmap.aio.connect(one.endpoint, timeout=LONG_S) as client:
            epoch = client.epoch
            one.send(signal.SIGSTOP)
            tasks = [asyncio.create_task(client.around(*COLD, wait=LONG_S)) for _ in range(100)]
            await until(lambda: len(table_of(client).entries) == 100)
            one.kill()
            await until(lambda: client.disconnected_since is not None)
            one.start()
            for cells in await asyncio.gather(*tasks):
                assert names(cells) == divided_map.in_circle(*COLD)
            assert client.epoch != epoch
            assert client.disconnected_since is None

    asyncio.run(main())


def test_a_daemon_that_is_gone(one: DaemonProcess) -> None:
    async def main() -> None:
        async with shmmap.aio.connect(one.endpoint, timeout=0.2) as client:
            one.kill()
            answers = await asyncio.gather(
                *(client.around(0, 0, 5, wait=0) for _ in range(10)), return_exceptions=True
            )
            assert [type(answer) for answer in answers] == [NoAnswer] * 10
            with pytest.raises(NoAnswer):
                await client.stats()

    asyncio.run(main())


def test_closed(one: DaemonProcess) -> None:
    async def main() -> None:
        client = await shmmap.aio.connect(one.endpoint)
        cells = await client.around(0, 0, 5)
        with standing_still(one):
            waiting = [asyncio.create_task(client.around(*COLD, wait=LONG_S)) for _ in range(3)]
            asked = asyncio.create_task(client.reload())
            await until(lambda: len(table_of(client).entries) >= 3)
            await client.close()
            for answer in await asyncio.gather(*waiting, return_exceptions=True):
                assert isinstance(answer, BadRequest)
                assert "closed" in str(answer)
        await asyncio.gather(asked, return_exceptions=True)
        await client.close()
        with pytest.raises(BadRequest, match="closed"):
            await client.around(0, 0, 1)
        with pytest.raises(BadRequest, match="closed"):
            await client.stats()
        assert cells[0].xyz.any()

    asyncio.run(main())


def test_connecting_is_cancelled(one: DaemonProcess) -> None:
    """The session that its thread begins is ended."""
    one.send(signal.SIGSTOP)

    async def main() -> None:
        connecting = asyncio.create_task(shmmap.aio.connect(one.endpoint)._connect())
        await asyncio.sleep(0.05)
        connecting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await connecting
        one.send(signal.SIGCONT)

    before = threads()
    asyncio.run(main())
    deadline = Deadline()
    while deadline(not threads() <= before):
        pass
    with shmmap.connect(one.endpoint) as client:
        assert len(client.stats().sessions) == 1


def threads() -> set[str]:
    return set(os.listdir("/proc/self/task"))


def test_connecting_is_cancelled_as_the_loop_ends(
    one: DaemonProcess, caplog: pytest.LogCaptureFixture
) -> None:
    async def main() -> None:
        asyncio.create_task(shmmap.aio.connect(one.endpoint)._connect())  # noqa: RUF006  it is cancelled
        await asyncio.sleep(0)

    before = threads()
    asyncio.run(main())
    deadline = Deadline()
    while deadline(not threads() <= before):
        pass
    assert not caplog.records
    with shmmap.connect(one.endpoint) as client:
        assert len(client.stats().sessions) == 1


def test_closing_is_cancelled(one: DaemonProcess) -> None:
    """It goes on, also where all threads of the executor are busy."""

    async def main() -> None:
        busy, ended = threading.Event(), threading.Event()

        def work() -> None:
            busy.set()
            ended.wait(LONG_S)

        with ThreadPoolExecutor(1) as executor:
            asyncio.get_running_loop().set_default_executor(executor)
            client = await shmmap.aio.connect(one.endpoint)
            stream = await shmmap.aio.EventStream(one.endpoint).__aenter__()
            working = asyncio.get_running_loop().run_in_executor(None, work)
            await until(busy.is_set)
            for closed in (client, stream):
                closing = asyncio.create_task(closed.close())
                await asyncio.sleep(0)
                closing.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await closing
            ended.set()
            await working
        with shmmap.connect(one.endpoint) as sync:
            assert len(sync.stats().sessions) == 1

    asyncio.run(main())


def test_a_client_that_is_dropped(one: DaemonProcess) -> None:
    """It is said; and its descriptors and threads go."""
    before = len(os.listdir("/proc/self/fd"))

    async def main() -> None:
        client = await shmmap.aio.connect(one.endpoint)
        await client.around(0, 0, 5)
        window = shmmap.aio.MapWindow(client, 5)
        await window.move_to(0, 0, wait=LONG_S)
        with pytest.warns(ResourceWarning, match="not closed"):
            del window
        await until(lambda: len(asyncio.all_tasks()) == 1)
        with pytest.warns(ResourceWarning, match="not closed"):  # noqa: PT031
            del client  # a task's end refers to itself, and to this
            gc.collect()

    asyncio.run(main())
    deadline = Deadline()
    while deadline(len(os.listdir("/proc/self/fd")) > before):
        pass


def test_elsewhere(one: DaemonProcess) -> None:
    """Another loop, in the same or another thread, is refused, and the client goes on."""

    async def main() -> None:
        async with shmmap.aio.connect(one.endpoint) as client:
            window = shmmap.aio.MapWindow(client, 5)

            async def ask() -> None:
                for coroutine in (
                    client.around(0, 0, 5),
                    client.stats(),
                    client.close(),
                    window.move_to(0, 0),
                ):
                    with pytest.raises(BadRequest, match="another event loop"):
                        await coroutine

            await asyncio.to_thread(asyncio.run, ask())
            assert (await client.around(0, 0, 5)).complete

    asyncio.run(main())


def test_a_loop_that_is_over(one: DaemonProcess) -> None:
    """A client that was not closed in its loop can be dropped, not used."""
    before = len(os.listdir("/proc/self/fd"))
    kept: list[shmmap.aio.Client] = []

    async def main() -> None:
        kept.append(await shmmap.aio.connect(one.endpoint))
        await kept[0].around(0, 0, 5)

    async def again() -> None:
        with pytest.raises(BadRequest, match="another event loop"):
            await kept[0].around(0, 0, 5)

    asyncio.run(main())
    asyncio.run(again())
    with pytest.warns(ResourceWarning, match="not closed"):
        kept.clear()
    deadline = Deadline()
    while deadline(len(os.listdir("/proc/self/fd")) > before):
        pass


FORK = """
import asyncio, os, sys
import shmmap, shmmap.aio
async def main():
    async with shmmap.aio.connect(sys.argv[1]) as client:
        cells = await client.around(0, 0, 5)
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                try:
                    client.around(0, 0, 5).send(None)
                except shmmap.BadRequest as error:
                    assert "parent process" in str(error)
                    client._driver.stop()
                    with shmmap.connect(sys.argv[1]) as mine:
                        assert len(mine.around(0, 0, 5)) == len(cells)
                    code = 0
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
        assert (await client.around(0, 0, 5)).cells == cells.cells
asyncio.run(main())
print("good")
"""


def test_fork(one: DaemonProcess) -> None:
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORK, one.endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S)
    assert (done.returncode, done.stdout) == (0, "good\n"), done.stderr


# --- windows ------------------------------------------------------------------------------------------


def test_a_window(run: Callable[[Main], Any], divided_map: DividedMap) -> None:
    """A drive: at each place the window has what is there, and who iterates knows the same."""

    async def main(client: shmmap.aio.Client) -> None:
        known: set[str] = set()

        async def follow(window: shmmap.aio.MapWindow) -> int:
            updates = 0
            async for update in window:
                known.difference_update(update.removed)
                known.update(cell.id for cell in (*update.added, *update.changed))
                updates += 1
            return updates

        async with shmmap.aio.MapWindow(client, 15, update_distance=5) as window:
            following = asyncio.create_task(follow(window))
            for step in range(-50, 50, 10):
                await window.move_to(step, 0, wait=LONG_S)
                assert window.complete
                assert names(window.cells) == divided_map.in_circle(step, 0, 15)
                assert window.covers(step, 0, 10)
                await until(lambda: known == {cell.id for cell in window.cells})
            near = window.points_around(40, 0, 5)
            assert near.covered
            assert near.count()
            assert window.error is None
        assert await asyncio.wait_for(following, LONG_S) > 5
        assert window.cells == ()
        with pytest.raises(BadRequest, match="closed"):
            await window.move_to(0, 0)

    run(main)


@pytest.mark.parametrize("turns", range(5))
def test_a_window_is_closed_just_as_it_is_called(run: Callable[[Main], Any], turns: int) -> None:
    """Its task ends, at whatever turn of the loop it is cancelled."""

    async def main(client: shmmap.aio.Client) -> None:
        window = shmmap.aio.MapWindow(client, 5)
        await window.move_to(0, 0, wait=LONG_S)
        await asyncio.sleep(0)
        window._follower._called.set()
        for _ in range(turns):
            await asyncio.sleep(0)
        await asyncio.wait_for(window.close(), LONG_S)

    run(main)


@pytest.mark.parametrize("turns", range(5))
def test_closing_a_window_is_cancelled(run: Callable[[Main], Any], turns: int) -> None:
    """What follows it learns of it nevertheless, and no cells are kept."""

    async def main(client: shmmap.aio.Client) -> None:
        async def follow() -> None:
            async for _ in window:
                pass

        window = shmmap.aio.MapWindow(client, 5)
        await window.move_to(0, 0, wait=LONG_S)
        following = asyncio.create_task(follow())
        closing = asyncio.create_task(window.close())
        for _ in range(turns):
            await asyncio.sleep(0)
        closing.cancel()
        await asyncio.wait([closing])
        await window.close()
        await asyncio.wait_for(following, LONG_S)
        assert window.cells == ()

    run(main)


def test_windows_beside_what_waits(one: DaemonProcess, run: Callable[[Main], Any]) -> None:
    async def main(client: shmmap.aio.Client) -> None:
        with standing_still(one):
            windows = [shmmap.aio.MapWindow(client, 5) for _ in range(5)]
            waiting = [asyncio.create_task(window.move_to(50, 50, wait=LONG_S)) for window in windows]
            await until(lambda: table_of(client)._waiting)
            for _ in range(5):
                assert (await client.around(0, 0, 5)).complete
            assert not await windows[0].wait_until_current(0.01)
            assert not any(task.done() for task in waiting)
        for update in await asyncio.gather(*waiting):
            assert names(update.added) == ["40_40.pcd"]
            assert update.complete
        for window in windows:
            await window.close()

    run(main)


def test_a_window_over_a_restart(one: DaemonProcess) -> None:
    """It keeps its cells, says why it is stale, and goes on with the next daemon."""

    async def main() -> None:
        async with (
            shmmap.aio.connect(one.endpoint, timeout=LONG_S) as client,
            shmmap.aio.MapWindow(client, 15, timeout=0.2) as window,
        ):
            await window.move_to(0, 0, wait=LONG_S)
            cells = window.cells
            one.kill()
            await until(lambda: window.error)
            assert window.stale_since is not None
            assert window.cells == cells
            one.start()
            await until(lambda: window.error is None and client.disconnected_since is None)
            update = await window.move_to(50, 50, wait=LONG_S)
            assert update.complete
            assert update.removed

    asyncio.run(main())


def test_parameters_of_a_window(run: Callable[[Main], Any]) -> None:
    async def main(client: shmmap.aio.Client) -> None:
        for wrong in ({"radius": -1.0}, {"shape": "oval"}, {"refresh_interval": 0.0}, {"timeout": -1.0}):
            with pytest.raises(BadRequest):
                shmmap.aio.MapWindow(client, **wrong)
        async with shmmap.aio.MapWindow(client, 5) as window:
            with pytest.raises(BadRequest, match="wait"):
                await window.move_to(0, 0, wait=-1)
            assert repr(window) == "<MapWindow of radius 5 m, 0 cells of points>"

    run(main)


# --- events -------------------------------------------------------------------------------------------


def test_events(one: DaemonProcess, run: Callable[[Main], Any]) -> None:
    """A reader that is cancelled loses none; over a restart they go on."""

    async def main(client: shmmap.aio.Client) -> None:
        async with shmmap.aio.EventStream(one.endpoint, since=3600) as stream:
            seen = []
            async for event in stream:
                seen.append(event)
                if isinstance(event, Loaded) and event.id.endswith("0_0.pcd"):
                    break
            assert isinstance(seen[0], Epoch)
            for wait_s in (0.0, 0.001, 0.01, 0.1):
                with contextlib.suppress(asyncio.TimeoutError):
                    while True:
                        await asyncio.wait_for(anext(stream), wait_s)
            await client.around(*COLD, wait=LONG_S)
            while not (isinstance(event := await anext(stream), Loaded) and event.id.endswith("40_40.pcd")):
                pass
            waiting = asyncio.create_task(ended(stream))
            await asyncio.sleep(0)
        assert await asyncio.wait_for(waiting, LONG_S)
        with pytest.raises(BadRequest, match="not entered"):
            await anext(shmmap.aio.EventStream(one.endpoint))

    async def ended(stream: shmmap.aio.EventStream) -> bool:
        async for _ in stream:
            pass
        return True

    run(main)


def test_closing_events_is_cancelled(one: DaemonProcess) -> None:
    """Nothing of the stream is left, though a task was waiting for its events."""
    before = len(os.listdir("/proc/self/fd"))

    async def main() -> None:
        stream = await shmmap.aio.EventStream(one.endpoint).__aenter__()
        waiting = asyncio.create_task(anext(stream))
        await until(lambda: stream._taking)
        closing = asyncio.create_task(stream.close())
        await asyncio.sleep(0)
        closing.cancel()
        await asyncio.wait([closing])
        with pytest.raises(StopAsyncIteration):
            await waiting

    asyncio.run(main())
    deadline = Deadline()
    while deadline(len(os.listdir("/proc/self/fd")) > before):
        pass


def test_events_that_are_dropped(one: DaemonProcess) -> None:
    before = len(os.listdir("/proc/self/fd"))

    async def main() -> None:
        stream = await shmmap.aio.EventStream(one.endpoint, since=3600).__aenter__()
        await anext(stream)
        with pytest.warns(ResourceWarning, match="not closed") as said:  # noqa: PT031
            del stream
            await until(lambda: gc.collect() >= 0 and len(said))  # a thread may have it for a moment

    asyncio.run(main())
    deadline = Deadline()
    while deadline(len(os.listdir("/proc/self/fd")) > before):
        pass


def test_events_over_a_restart(one: DaemonProcess) -> None:
    async def main() -> None:
        async with shmmap.aio.EventStream(one.endpoint) as stream:
            one.kill()
            one.start()
            async for event in stream:
                if isinstance(event, Epoch) and event.what == "started":
                    break

    asyncio.run(main())
