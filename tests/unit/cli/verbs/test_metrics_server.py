# SPDX-License-Identifier: Apache-2.0
"""The server of metrics: its one page, errors as answers, and peers that say nothing."""

from __future__ import annotations

import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from shmmap.cli.listening import listening_at
from shmmap.cli.verbs.look import metrics_server
from shmmap.cli.verbs.look.metrics_server import MetricsServer
from shmmap.errors import MapDataError

PAGE = "shmmap_up 1\n"


@pytest.fixture
def served() -> Iterator[MetricsServer]:
    with MetricsServer(listening_at("127.0.0.1", 0), lambda: PAGE) as server:
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
