# SPDX-License-Identifier: Apache-2.0
"""The server of metrics: addresses, its one page, errors as answers, and peers that say nothing."""

from __future__ import annotations

import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from shmmap.cli.verbs.look import metrics_server
from shmmap.cli.verbs.look.metrics_server import MetricsServer, listen_address
from shmmap.errors import BadRequest, InstanceBusy, MapDataError

PAGE = "shmmap_up 1\n"


@pytest.fixture
def served() -> Iterator[MetricsServer]:
    with MetricsServer("127.0.0.1", 0, lambda: PAGE) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def get(url: str, method: str = "GET") -> tuple[int, str, str]:
    """Status, content type and text of an answer."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method=method), timeout=20) as answer:
            return answer.status, answer.headers["Content-Type"], answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.headers["Content-Type"], error.read().decode()


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("9731", ("127.0.0.1", 9731)),
        (":9731", ("127.0.0.1", 9731)),
        ("0", ("127.0.0.1", 0)),
        ("0.0.0.0:80", ("0.0.0.0", 80)),
        ("localhost:65535", ("localhost", 65535)),
        ("[::1]:9731", ("::1", 9731)),
    ],
)
def test_addresses(text: str, address: tuple[str, int]) -> None:
    assert listen_address(text) == address


@pytest.mark.parametrize(
    "text", ["", "localhost", "::1:9731", "[::1]", "[x]:1", "1.2.3.4:65536", "h:-1", "h:٣"]
)
def test_what_is_no_address(text: str) -> None:
    with pytest.raises(BadRequest, match="is no address to listen at"):
        listen_address(text)


def test_its_pages(served: MetricsServer) -> None:
    plain = "text/plain; version=0.0.4; charset=utf-8"
    assert get(served.url) == (200, plain, PAGE)
    assert get(f"{served.url}?format=text") == (200, plain, PAGE)
    assert get(served.url, "HEAD") == (200, plain, "")
    assert get(served.url.removesuffix("metrics"))[0] == 200
    assert get(f"{served.url}/x")[0] == 404
    assert get(served.url, "POST")[0] == 501


def test_an_error_is_an_answer(served: MetricsServer) -> None:
    def fails() -> str:
        raise MapDataError("the statistics cannot be read", path="/dev/shm/x")

    served.scrape = fails
    status, _, text = get(served.url)
    assert status == 503
    assert "cannot be read" in text


def test_peers_that_say_nothing_keep_no_one_waiting(served: MetricsServer) -> None:
    """Up to the limit each has a thread; those beyond it are closed at once."""
    address = served.address
    silent = [socket.create_connection(address, timeout=20) for _ in range(15)]
    try:
        assert get(served.url)[0] == 200
        while served._places._value:
            silent.append(socket.create_connection(address, timeout=20))
        beyond = socket.create_connection(address, timeout=20)
        silent.append(beyond)
        assert beyond.recv(1) == b""
    finally:
        for one in silent:
            one.close()


def test_a_silent_peer_is_given_up(served: MetricsServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_server._Handler, "timeout", 0.05)
    with socket.create_connection(served.address, timeout=20) as silent:
        silent.sendall(b"GET /met")
        assert silent.recv(1) == b""


def test_where_it_cannot_listen(served: MetricsServer) -> None:
    with pytest.raises(InstanceBusy, match=r"another program listens at 127\.0\.0\.1 port"):
        MetricsServer(*served.address, lambda: PAGE)
    with pytest.raises(BadRequest, match="this machine has no such address"):
        MetricsServer("192.0.2.1", 1, lambda: PAGE)
