# SPDX-License-Identifier: Apache-2.0
"""GATEWAY.md is true: its configuration runs as it stands, in real nginx, before a server that fails."""

from __future__ import annotations

import subprocess
import threading
import urllib.request
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.command_line import publish
from tests.support.daemon_process import ROOT, first_answer
from tests.support.divided_map import make_map
from tests.support.pages import read_page
from tests.support.published_daemon import ALL, all_cells
from tests.support.web_servers import FaultyWeb, Nginx, faulty_web, free_port, needed_nginx

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

PAGE = read_page("shmmap/publishing/GATEWAY.md")
CONFIGURATION = PAGE.path.with_name("gateway.nginx.conf")
ASKERS = 16


@pytest.fixture
def origin(tmp_path: Path) -> Iterator[FaultyWeb]:
    """The server behind the gateway, which records requests."""
    needed_nginx()
    made = make_map(tmp_path / "files", columns=3, rows=3, points=300)
    publish(made.root, tmp_path / "www/town")
    with faulty_web(tmp_path / "www") as web:
        yield web


def configured(origin: FaultyWeb, folder: Path, port: int) -> str:
    """The configuration, with this machine's places and ports; nothing else is changed."""
    text = CONFIGURATION.read_text(encoding="utf-8")
    for there, here, times in (
        ("https://maps.example.org;", f"{origin.url};", 2),
        ("listen 8080;", f"listen 127.0.0.1:{port};", 1),
        ("pid /run/nginx.pid;", f"pid {folder}/nginx.pid;", 1),
        ("/var/cache/shmmap-gateway", str(folder / "cache"), 7),
    ):
        assert text.count(there) == times, there
        text = text.replace(there, here)
    return text


@pytest.fixture
def gateway(origin: FaultyWeb, tmp_path: Path) -> Iterator[Nginx]:
    folder, port = tmp_path / "gateway", free_port()
    (folder / "cache").mkdir(parents=True)
    nginx = Nginx(configured(origin, folder, port), folder, port)
    nginx.start()
    try:
        yield nginx
    finally:
        nginx.kill()


def test_the_configuration_is_one(gateway: Nginx) -> None:
    assert "nginx -t" in PAGE.commands("start")
    assert f"cp {CONFIGURATION.relative_to(ROOT)} /etc/nginx/nginx.conf" in PAGE.commands("start")
    done = subprocess.run([*gateway.command, "-t"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (serve,) = PAGE.commands("serve")
    assert serve == "shmmap serve http://gateway.lan:8080/town --insecure-http"


def test_sixteen_that_ask_at_once_are_one_to_the_server(gateway: Nginx, origin: FaultyWeb) -> None:
    blobs = sorted((origin.folder / "town/blobs/sha256").iterdir())
    together = threading.Barrier(ASKERS)

    def ask(path: str) -> bytes:
        together.wait()
        with urllib.request.urlopen(f"http://127.0.0.1:{gateway.port}/town/{path}", timeout=60) as reply:
            data: bytes = reply.read()
            return data

    with ThreadPoolExecutor(ASKERS) as pool:
        for blob in blobs[:4]:
            answers = list(pool.map(ask, [f"blobs/sha256/{blob.name}"] * ASKERS))
            assert set(answers) == {blob.read_bytes()}
    asked = Counter(path for path, _status in origin.requests())
    assert asked == {f"town/blobs/sha256/{blob.name}": 1 for blob in blobs[:4]}


def test_daemons_behind_it_fetch_each_object_once_and_outlive_the_server(
    gateway: Nginx, origin: FaultyWeb, daemon: DaemonFactory
) -> None:
    url = f"http://127.0.0.1:{gateway.port}/town"
    found = []
    for one in [daemon(url, "--poll", "1") for _ in range(2)]:
        with shmmap.connect(one.endpoint) as client:
            cells = client.area(ALL, wait=120.0)
            assert cells.complete, cells.failed
            found.append({cell.id: cell.version for cell in cells})
    assert found[0] == found[1]
    asked = Counter(path for path, _status in origin.requests() if "/blobs/" in path)
    blobs = {f"town/blobs/sha256/{path.name}" for path in (origin.folder / "town/blobs/sha256").iterdir()}
    assert asked == dict.fromkeys(blobs, 1)

    origin.refuse()
    third = daemon(url, "--poll", "1")
    with shmmap.connect(third.endpoint) as client:
        cells = client.area(ALL, wait=120.0)
        assert cells.complete, cells.failed
        assert {cell.id: cell.version for cell in cells} == found[0]
        assert client.reload().map_version


def test_a_new_version_comes_through(
    gateway: Nginx, origin: FaultyWeb, daemon: DaemonFactory, tmp_path: Path
) -> None:
    one = daemon(f"http://127.0.0.1:{gateway.port}/town", "--poll", "0")
    with shmmap.connect(one.endpoint) as client:
        before = client.area(ALL, wait=120.0).map_version
        other = make_map(tmp_path / "other", columns=3, rows=3, points=200)
        publish(other.root, origin.folder / "town")
        first_answer(client.reload, lambda one: one.map_version != before)
        assert client.area(ALL, wait=120.0).complete
    assert ("town/CURRENT", 200) in origin.requests()


def test_what_it_does_not_have_is_offline_while_the_server_is_away(
    gateway: Nginx, origin: FaultyWeb, daemon: DaemonFactory
) -> None:
    one = daemon(f"http://127.0.0.1:{gateway.port}/town", "--poll", "0")
    with shmmap.connect(one.endpoint) as client:
        near = client.around(-25.0, -25.0, 5.0, wait=120.0)
        assert near.complete
        origin.refuse()
        cells = client.area(ALL, wait=120.0)
        assert {failure.code for failure in cells.failed} == {"offline"}
        assert {cell.id for cell in near} <= {cell.id for cell in cells}
        origin.listen()
        assert len(all_cells(client)) == 9
