# SPDX-License-Identifier: Apache-2.0
"""An exception from a signal handler, at every place of a request at which Python runs handlers.

Python runs them when a function begins, after a call, and at a jump back.  Here tracing raises at each of
these places in turn, one in each run of the same request, in all code of ours and of what we use; random
instants are for ``tests/benchmarks/interrupts.py``.
"""

from __future__ import annotations

import contextlib
import ctypes
import dis
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
import zmq

import shmmap
from shmmap.client import connection_watch
from shmmap.client.connection_watch import running, start_thread
from shmmap.client.window import follower
from shmmap.errors import BadRequest
from tests.support.daemon_process import DaemonProcess, until

LONG_S = 60.0

_libc = ctypes.CDLL(None)

_BEFORE = ("CALL", "RESUME", "JUMP_BACKWARD", "JUMP_ABSOLUTE")
"""Instructions after which Python runs handlers, by how their names begin."""


@pytest.fixture(autouse=True)
def nothing_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where Python ignores exceptions it says so, and pytest keeps them, with all that they refer to."""
    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)


class Interrupt(BaseException):
    """What a handler raises."""


@cache
def places_in(code: CodeType) -> frozenset[int]:
    """Where handlers may run in some code, by the offset of what comes next.

    An exception of theirs comes from the instruction before, one of tracing from the next: where these two
    are not in the same block, tracing cannot do the same, and the place is left out.
    """
    steps = [step for step in dis.get_instructions(code) if step.opname not in ("CACHE", "PRECALL")]
    blocks = getattr(dis.Bytecode(code), "exception_entries", ())  # since Python 3.11

    def block(offset: int) -> object:
        return next((one for one in blocks if one.start <= offset < one.end), None)

    return frozenset(
        after.offset
        for before, after in pairwise(steps)
        if before.opname.startswith(_BEFORE) and block(before.offset) == block(after.offset)
    )


class AtPlace:
    """Raises at the Nth place at which a handler may run."""

    def __init__(self, number: int) -> None:
        self.left = number

    def __call__(self, frame: FrameType, event: str, argument: object) -> Any:
        del argument
        frame.f_trace_opcodes = True
        frame.f_trace_lines = False
        if event == "call" or (event == "opcode" and frame.f_lasti in places_in(frame.f_code)):
            self.left -= 1
            if not self.left:
                sys.settrace(None)
                raise Interrupt
        return self


def threads() -> set[str]:
    """Numbers of the threads of this process."""
    return set(os.listdir("/proc/self/task"))


def await_end_of_threads(known: set[str]) -> None:
    """Wait until there is no thread but these: one that has said that it is over still has to end."""
    until(lambda: threads() <= known)


def holdings(one: DaemonProcess) -> tuple[int, int, int]:
    """Descriptors, mappings of segments, and threads of this process."""
    gc.collect()
    maps = Path("/proc/self/maps").read_text()
    return len(os.listdir("/proc/self/fd")), maps.count(one.shm_dir), len(threads())


def lock_of(client: shmmap.Client) -> threading.Lock:
    """Return what a client's thread holds while it uses the socket."""
    connection = client.session._connection
    assert connection is not None
    return connection._exchange.lock


def interrupted_everywhere(work: Callable[[], object], check: Callable[[int], None]) -> int:
    """Repeat the work, each time interrupted at the next place; returns the number of places."""
    number, tracing = 0, sys.gettrace()
    done = False
    while not done:
        number += 1
        place = AtPlace(number)
        try:
            sys.settrace(place)
            work()
            done = place.left > 0
        except Interrupt:
            pass
        finally:
            sys.settrace(tracing)
        check(number)
    return number


def test_a_request_that_attaches(standing: DaemonProcess) -> None:
    """Nothing stays open or mapped, the next request is answered, and answered rightly."""
    with shmmap.connect(standing.endpoint, timeout=LONG_S) as client:
        expected = {cell.version for cell in client.around(10, 10, 1, wait=LONG_S)}
        assert len(expected) == 1
        client.release()
        before = holdings(standing)

        def check(number: int) -> None:
            until(lambda: not lock_of(client).locked())  # the thread has it for moments
            if number % 8 == 0:
                assert holdings(standing) == before, number
            assert {cell.version for cell in client.around(10, 10, 1)} == expected, number

        places = interrupted_everywhere(lambda: client.around(10, 10, 1), check)
        assert places > 100, "is anything traced?"
        assert holdings(standing) == before
        assert client.release() == 1


def test_what_a_window_does_in_the_calling_thread(standing: DaemonProcess) -> None:
    with shmmap.connect(standing.endpoint, timeout=LONG_S) as client, shmmap.MapWindow(client, 15) as window:
        window.move_to(0, 0, wait=LONG_S)
        places = [5.0, 0.0]

        def move() -> None:
            window.move_to(places[0] * 10, 0, wait=LONG_S)

        def check(number: int) -> None:
            places.reverse()
            assert window.wait_until_current(LONG_S), number

        assert interrupted_everywhere(move, check) > 30


def test_closing(standing: DaemonProcess) -> None:
    """A close that was interrupted can be repeated, and the next connection ends what was left."""
    known = threads()
    shmmap.connect(standing.endpoint).close()
    await_end_of_threads(known)
    before = holdings(standing)
    number, done = 0, False
    while not done:
        number += 1
        client = shmmap.connect(standing.endpoint, timeout=LONG_S)
        place = AtPlace(number)
        try:
            sys.settrace(place)
            client.close()
            done = place.left > 0
        except Interrupt:
            pass
        finally:
            sys.settrace(None)
        client.close()
        del client
        if number % 8 == 0 or done:
            shmmap.connect(standing.endpoint).close()
            await_end_of_threads(known)
            assert holdings(standing) == before, number
    assert number > 20


def leaves_nothing(one: DaemonProcess, work: Callable[[], object]) -> Callable[[int], None]:
    """Return what fails, every sixteenth time, if this process holds more than after doing the work once."""
    known = threads()
    work()
    await_end_of_threads(known)
    before = holdings(one)

    def check(number: int) -> None:
        if number % 16 == 0:
            gc.collect()
            shmmap.connect(one.endpoint).close()
            await_end_of_threads(known)
            assert holdings(one) == before, number

    return check


def test_connecting(standing: DaemonProcess) -> None:
    check = leaves_nothing(standing, lambda: shmmap.connect(standing.endpoint).close())
    assert interrupted_everywhere(lambda: shmmap.connect(standing.endpoint, name="x").close(), check) > 100


def test_following_events(standing: DaemonProcess) -> None:
    check = leaves_nothing(standing, lambda: shmmap.events.EventStream(standing.endpoint).close())

    def follow() -> None:
        shmmap.events.EventStream(standing.endpoint, name="x", timeout=LONG_S).close()

    assert interrupted_everywhere(follow, check) > 100


OPENS: dict[str, Callable[[str], Any]] = {
    "client": shmmap.connect,
    "events": shmmap.events.EventStream,
    "window": lambda endpoint: shmmap.MapWindow(endpoint, 15),
}


@pytest.mark.parametrize("what", OPENS)
def test_threads_that_begin_after_the_client_has_closed(
    standing: DaemonProcess, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """On a busy machine that may be after the next connection, and no other may come."""
    known = threads()
    begun: list[Callable[[], None]] = []

    def later(run: Callable[..., object], *arguments: object) -> None:
        begun.append(partial(start_thread, run, *arguments))
        raise Interrupt

    OPENS[what](standing.endpoint).close()
    await_end_of_threads(known)
    before = holdings(standing), len(running)
    with monkeypatch.context() as patch:
        patch.setattr(follower if what == "window" else connection_watch, "start_thread", later)
        with contextlib.suppress(Interrupt):
            OPENS[what](standing.endpoint)
    shmmap.connect(standing.endpoint).close()
    (begin,) = begun
    begin()
    await_end_of_threads(known)
    assert (holdings(standing), len(running)) == before


# --- a signal that comes to another thread ------------------------------------------------------------


@pytest.mark.parametrize("what", ["client", "events"])
def test_a_signal_while_libzmq_ends(standing: DaemonProcess, what: str) -> None:
    """The kernel may choose any thread for it; where it interrupts the end, half of a context stays."""
    socket: zmq.Socket[bytes]

    def made() -> tuple[Callable[[], None], zmq.Socket[bytes]]:
        if what == "events":
            stream = shmmap.events.EventStream(standing.endpoint, timeout=LONG_S)
            return stream.close, stream._socket
        client = shmmap.connect(standing.endpoint, timeout=LONG_S)
        connection = client.session._connection
        assert connection is not None
        return client.close, connection._exchange.socket

    known = threads()
    made()[0]()
    await_end_of_threads(known)
    before = holdings(standing)
    close, socket = made()
    hold_up = socket.context.socket(zmq.PAIR)  # the context ends when the last socket of it is closed
    closing = threading.Thread(target=close)
    handled = signal.signal(signal.SIGUSR1, lambda *_: None)
    try:
        closing.start()
        while not socket.closed:
            time.sleep(0.001)
        main = os.getpid()
        for _ in range(50):
            for thread in set(map(int, threads())) - {main}:
                _libc.tgkill(main, thread, signal.SIGUSR1)
            time.sleep(0.001)
    finally:
        hold_up.close()
        closing.join()
        # one that a thread has not taken yet would end the process by default: to be ignored is to be dropped
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)
        signal.signal(signal.SIGUSR1, handled)
    del close, socket, hold_up, closing
    await_end_of_threads(known)
    assert holdings(standing) == before


# --- a client used in a handler -----------------------------------------------------------------------


@pytest.mark.parametrize("use", ["ask", "close"])
def test_a_client_in_a_handler_that_interrupted_it(standing: DaemonProcess, use: str) -> None:
    """It says so at once, and the request that was interrupted goes on."""
    seen: list[BadRequest] = []
    with shmmap.connect(standing.endpoint, timeout=LONG_S) as client:
        client.around(0, 0, 30, wait=LONG_S)
        waiting = threading.Event()

        def handle(number: int, frame: FrameType | None) -> None:
            del number, frame
            with pytest.raises(BadRequest, match="signal handler") as raised:
                client.stats() if use == "ask" else client.close()
            seen.append(raised.value)
            standing.send(signal.SIGCONT)

        before = signal.signal(signal.SIGUSR1, handle)
        try:
            standing.send(signal.SIGSTOP)

            def interrupt() -> None:
                while not lock_of(client).locked():
                    pass
                os.kill(os.getpid(), signal.SIGUSR1)
                waiting.set()

            thread = threading.Thread(target=interrupt)
            thread.start()
            assert client.around(0, 0, 30, wait=LONG_S).complete
            thread.join()
        finally:
            standing.send(signal.SIGCONT)
            signal.signal(signal.SIGUSR1, before)
        assert waiting.is_set()
        assert "flag" in seen[0].hint
        assert client.stats().epoch == client.epoch


def test_a_handler_may_use_the_client_between_requests(standing: DaemonProcess) -> None:
    answers = []
    with shmmap.connect(standing.endpoint, timeout=LONG_S) as client:
        before = signal.signal(signal.SIGUSR1, lambda *_: answers.append(client.stats()))
        try:
            signal.raise_signal(signal.SIGUSR1)
        finally:
            signal.signal(signal.SIGUSR1, before)
    assert answers
