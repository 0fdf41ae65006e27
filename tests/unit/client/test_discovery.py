# SPDX-License-Identifier: Apache-2.0
"""Finding the daemon: every failure has an error of its own, against real sockets."""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq

import shmmap
from shmmap.client.discovery import candidates, find_socket
from shmmap.errors import BadRequest, NoAnswer, NoSocket, ProtocolMismatch, SocketPermission, StaleSocket

SOON_S = 0.3
"""How long a test waits for a daemon that does not answer."""


@pytest.fixture
def place() -> Iterator[Path]:
    path = Path(tempfile.mkdtemp(prefix="shmmap-unit-", dir="/tmp"))  # short: socket paths end at 107 bytes
    yield path
    shutil.rmtree(path)


@contextmanager
def listening(path: Path, kind: socket.SocketKind = socket.SOCK_STREAM) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, kind) as server:
        server.bind(str(path))
        if kind == socket.SOCK_STREAM:
            server.listen(8)
        yield server


def connect(path: Path | str) -> None:
    shmmap.connect(path, connect_timeout=SOON_S).close()


def test_candidates_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = tmp_path / "shmmap-7"  # this user may have one in /tmp
    monkeypatch.setattr("shmmap.protocol.endpoint.fallback_runtime_dir", lambda: str(own))
    environ = {"XDG_RUNTIME_DIR": "/run/user/7"}
    assert candidates(None, environ) == ["/run/user/7/shmmap/default.sock", "/run/shmmap/default.sock"]
    assert candidates(None, {}) == ["/run/shmmap/default.sock"]
    assert candidates(None, {**environ, "SHMMAP_ENDPOINT": "ipc:///a/b.sock"}) == ["/a/b.sock"]
    named = {**environ, "SHMMAP_INSTANCE": "town"}
    assert candidates(None, named) == ["/run/user/7/shmmap/town.sock", "/run/shmmap/town.sock"]
    assert candidates(None, {**named, "SHMMAP_RUNTIME_DIR": "/r"}) == ["/r/town.sock"]
    assert candidates("/c.sock", {"SHMMAP_ENDPOINT": "/a/b.sock"}) == ["/c.sock"]
    own.mkdir(mode=0o700)
    assert candidates(None, {}) == [f"{own}/default.sock", "/run/shmmap/default.sock"]
    with pytest.raises(BadRequest, match="tcp"):
        candidates("tcp://host:1", {})
    with pytest.raises(BadRequest, match="107"):
        candidates("/" + "x" * 107, {})


def test_no_socket(place: Path) -> None:
    with pytest.raises(NoSocket, match="there is no socket") as caught:
        connect(place / "none.sock")
    assert str(place / "none.sock") in str(caught.value)
    assert "shmmap serve" in caught.value.hint


def test_no_directory_and_no_socket_file(place: Path) -> None:
    with pytest.raises(NoSocket):
        connect(place / "nowhere" / "none.sock")
    (place / "file").write_text("text")
    with pytest.raises(NoSocket, match="is not a socket"):
        connect(place / "file")
    with pytest.raises(NoSocket):
        connect(place / "file" / "below.sock")


def test_stale_socket(place: Path) -> None:
    with listening(place / "old.sock"):
        pass
    with pytest.raises(StaleSocket, match="gone"):
        connect(place / "old.sock")


@pytest.mark.root
def test_no_permission(place: Path) -> None:
    with listening(place / "s.sock"):
        (place / "s.sock").chmod(0o600)
        place.chmod(0o755)
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                os.setresgid(65534, 65534, 65534)
                os.setresuid(65534, 65534, 65534)
                connect(place / "s.sock")
            except SocketPermission:
                code = 0
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def test_a_listener_that_says_nothing_is_no_answer(place: Path) -> None:
    with listening(place / "s.sock"), pytest.raises(NoAnswer, match="does not answer"):
        connect(place / "s.sock")


def test_a_full_queue_of_connections_is_no_answer(place: Path) -> None:
    with listening(place / "s.sock") as server:
        server.listen(0)
        others = []
        while True:
            one = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
            others.append(one)
            try:
                one.connect(str(place / "s.sock"))
            except BlockingIOError:
                break
        with pytest.raises(NoAnswer):
            connect(place / "s.sock")
        for one in others:
            one.close()


def test_a_full_queue_of_connections_is_waited_for(place: Path) -> None:
    """Sixty programs that start together fill it."""
    with listening(place / "s.sock") as server, ThreadPoolExecutor(1) as pool:
        server.listen(0)
        first = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        first.connect(str(place / "s.sock"))
        found = pool.submit(find_socket, [str(place / "s.sock")], time.monotonic() + 60)
        with pytest.raises(TimeoutError):
            found.result(0.1)
        server.accept()[0].close()
        accepted, _ = server.accept()
        accepted.sendall(b"\xff\0\0\0\0\0\0\0\1\x7f")
        assert found.result(60) == str(place / "s.sock")
        accepted.close()
        first.close()


@pytest.mark.parametrize("words", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\xff\0\0\0\0\0\0\0\x01\x01"])
def test_another_program_is_a_protocol_mismatch(place: Path, words: bytes) -> None:
    with listening(place / "s.sock") as server:

        def speak() -> None:
            connection, _ = server.accept()
            connection.sendall(words)
            connection.close()

        thread = threading.Thread(target=speak)
        thread.start()
        with pytest.raises(ProtocolMismatch, match="does not speak ZeroMQ"):
            connect(place / "s.sock")
        thread.join()


def test_a_daemon_that_ends_before_it_answers(place: Path) -> None:
    """A socket that was made for it: the connection waited, and was never accepted."""
    with listening(place / "s.sock") as server:
        thread = threading.Thread(target=lambda: server.accept()[0].close())
        thread.start()
        with pytest.raises(StaleSocket, match="closed the connection without an answer"):
            connect(place / "s.sock")
        thread.join()


def test_a_socket_of_another_kind_is_a_protocol_mismatch(place: Path) -> None:
    with (
        listening(place / "s.sock", socket.SOCK_DGRAM),
        pytest.raises(ProtocolMismatch, match="another kind"),
    ):
        connect(place / "s.sock")


Answer = Callable[[list[bytes]], list[bytes]]


@contextmanager
def zmq_peer(path: Path, kind: int, answer: Answer | None = None) -> Iterator[None]:
    """Run a ZeroMQ program that is no shmmap daemon."""
    with zmq.Context() as context, context.socket(kind) as peer, context.socket(zmq.PAIR) as stop:
        peer.linger = 0
        peer.bind(f"ipc://{path}")
        stop.bind("inproc://stop")
        with context.socket(zmq.PAIR) as stopper:
            stopper.connect("inproc://stop")

            def serve() -> None:
                poller = zmq.Poller()
                poller.register(stop, zmq.POLLIN)
                poller.register(peer, zmq.POLLIN)
                while True:
                    ready = dict(poller.poll())
                    if stop in ready:
                        return
                    frames = peer.recv_multipart()
                    if answer is not None:
                        peer.send_multipart(answer(frames))

            thread = threading.Thread(target=serve)
            thread.start()
            try:
                yield
            finally:
                stopper.send(b"")
                thread.join()


@pytest.mark.parametrize(
    ("kind", "answer", "error", "said"),
    [
        (zmq.DEALER, None, NoAnswer, "no welcome"),
        (zmq.ROUTER, lambda frames: frames, ProtocolMismatch, None),
        (zmq.SUB, None, ProtocolMismatch, "no shmmap daemon"),
    ],
)
def test_a_zeromq_program_that_is_no_daemon(
    place: Path, kind: int, answer: Answer | None, error: type[Exception], said: str | None
) -> None:
    with zmq_peer(place / "s.sock", kind, answer), pytest.raises(error, match=said):
        connect(place / "s.sock")


def test_a_daemon_that_ends_while_one_connects(place: Path) -> None:
    """It hung up once, and is gone: that is no reason to take it for another program."""
    with listening(place / "s.sock") as server:

        def end() -> None:
            probe, _ = server.accept()
            probe.sendall(b"\xff\0\0\0\0\0\0\0\x01\x7f")
            connection, _ = server.accept()
            server.close()
            (place / "s.sock").unlink()
            probe.close()
            connection.close()

        thread = threading.Thread(target=end)
        thread.start()
        with pytest.raises(NoAnswer):
            connect(place / "s.sock")
        thread.join()


def test_all_places_are_named(place: Path) -> None:
    with listening(place / "stale.sock"):
        pass
    with pytest.raises(StaleSocket) as caught:
        find_socket([str(place / "none.sock"), str(place / "stale.sock")], time.monotonic() + SOON_S)
    assert f"{place}/none.sock: there is no socket" in str(caught.value)
    assert f"{place}/stale.sock" in str(caught.value)
    with pytest.raises(NoSocket, match=r"one\.sock.*two\.sock"):
        find_socket([str(place / "one.sock"), str(place / "two.sock")], time.monotonic() + SOON_S)


def test_a_silent_daemon_is_not_passed_over_for_another(place: Path) -> None:
    with (
        listening(place / "hung.sock"),
        zmq_peer(place / "other.sock", zmq.ROUTER),
        pytest.raises(NoAnswer, match="hung"),
    ):
        find_socket([str(place / "hung.sock"), str(place / "other.sock")], time.monotonic() + SOON_S)


def test_other_instances_are_named(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = place / "shmmap"
    directory.mkdir()
    monkeypatch.delenv("SHMMAP_ENDPOINT", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(place))
    monkeypatch.setattr("shmmap.protocol.endpoint.SYSTEM_RUNTIME_DIR", str(place / "system"))
    with (
        listening(directory / "garage.sock"),
        pytest.raises(NoSocket, match=r"garage; name one: connect"),
    ):
        shmmap.connect()


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan")])
def test_impossible_timeouts_are_refused(place: Path, seconds: float) -> None:
    with pytest.raises(BadRequest, match="timeout"):
        shmmap.connect(place / "s.sock", timeout=seconds)
