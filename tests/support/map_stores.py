# SPDX-License-Identifier: Apache-2.0
"""Fixtures: stores of published maps on this machine."""

from __future__ import annotations

import functools
import http.server
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.bucket_server import BucketServer, bucket_server
from tests.support.ceph import ceph_server
from tests.support.divided_map import make_map
from tests.support.publishing_verbs import Shmmap

__all__ = ["_buckets", "buckets", "signed_maps", "web"]


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


@pytest.fixture(scope="session")
def signed_maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One map of two cells, signed: with versions 1 and 2, another version 2, and signed by others.

    Directories ``one``, ``two``, ``equal``, ``other``; their ``keys`` and ``others``; ``town`` has the files.
    """
    from tests.support.signed_map import Signed

    folder = tmp_path_factory.mktemp("signed")
    made = make_map(folder / "town", columns=2, rows=1, points=100)
    run = Shmmap(folder)
    run("publish", made.root, folder / "one", "--sign", folder / "keys", "--id-prefix", "/town/")
    shutil.copytree(folder / "one", folder / "two")
    shutil.copytree(folder / "one", folder / "equal")
    made.change("0_0.pcd", seed=1)
    run("publish", made.root, folder / "two", "--sign", folder / "keys")
    run("publish", made.root, folder / "other", "--sign", folder / "others", "--id-prefix", "/town/")
    made.change("0_0.pcd", seed=2)
    run("publish", made.root, folder / "equal", "--sign", folder / "keys")
    Signed(folder / "equal", folder / "keys").write_all(3)  # newer than the other version 2
    return folder
