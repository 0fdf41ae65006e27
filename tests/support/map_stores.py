# SPDX-License-Identifier: Apache-2.0
"""Fixtures: stores of published maps on this machine."""

from __future__ import annotations

import functools
import http.server
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.bucket_server import BucketServer, bucket_server
from tests.support.ceph import ceph_server

__all__ = ["_buckets", "buckets", "web"]


@pytest.fixture(scope="session")
def _buckets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BucketServer]:
    pytest.importorskip("obstore", reason="obstore is not installed")
    pytest.importorskip("moto", reason="moto is not installed")
    if os.environ.get("SHMMAP_TEST_CEPH"):
        with ceph_server() as cluster:
            yield cluster
        return
    with bucket_server(tmp_path_factory.mktemp("buckets")) as server:
        yield server


@pytest.fixture
def buckets(_buckets: BucketServer, monkeypatch: pytest.MonkeyPatch) -> BucketServer:
    """An S3 server, and this process configured for it."""
    for name, value in _buckets.environment.items():
        monkeypatch.setenv(name, value)
    _buckets.requests()
    return _buckets


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments: object) -> None:
        del arguments


@pytest.fixture
def web(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A plain web server: its URL and its directory."""
    pytest.importorskip("obstore", reason="obstore is not installed")
    folder = tmp_path / "web"
    folder.mkdir()
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(_Quiet, directory=str(folder))
    )
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", folder
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
