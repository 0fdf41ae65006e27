# SPDX-License-Identifier: Apache-2.0
"""A published directory behind nginx as a plain web server: as files, while it is cut off, and after."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.command_line import publish
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map
from tests.support.published_daemon import ALL, all_cells, until
from tests.support.web_servers import Nginx, free_port, needed_nginx, web_server

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

SLOWLY = "limit_rate 1k;"
"""A cell takes half a minute: a connection that is cut off was in the middle of one."""

Cells = dict[str, bytes]


class Town:
    """The map's files, the published directory, and nginx in front of it."""

    def __init__(self, folder: Path) -> None:
        self.files = make_map(folder / "town", columns=2, rows=2, points=3000)
        publish(self.files.root, folder / "www/town")
        self.port = free_port()
        self.root = folder / "www"
        self.nginx = Nginx(self.configuration(), folder / "nginx", self.port)

    def configuration(self, more: str = "") -> str:
        return web_server(self.root, self.root.parent / "nginx", self.port, more)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/town"

    def restart(self, more: str = "") -> None:
        self.nginx.kill()
        self.nginx.configure(self.configuration(more))
        self.nginx.start()


@pytest.fixture
def town(tmp_path: Path) -> Iterator[Town]:
    needed_nginx()
    one = Town(tmp_path)
    one.nginx.start()
    try:
        yield one
    finally:
        one.nginx.kill()


def of_files(files: DividedMap) -> Cells:
    return {name: files.points(name)["x"].tobytes() for name in files.corners}


def loaded(cells: shmmap.CellSet) -> Cells:
    return {cell.id.rsplit("/", 1)[1]: cell.xyz[:, 0].tobytes() for cell in cells}


def test_cells_are_those_of_the_files_and_polls_are_answered_by_not_modified(
    daemon: DaemonFactory, town: Town, tmp_path: Path
) -> None:
    log = tmp_path / "asked.log"
    town.restart(f"access_log {log};")
    with shmmap.connect(daemon(town.url, "--poll", "1").endpoint) as client:
        assert loaded(all_cells(client)) == of_files(town.files)
    until(lambda: '/town/CURRENT HTTP/1.1" 304' in log.read_text())


def ask_all(one: DaemonProcess, answers: list[Cells]) -> None:
    with shmmap.connect(one.endpoint, timeout=240.0) as client:
        answers.append(loaded(client.area(ALL, wait=200.0)))


def test_transfers_that_are_cut_off_are_begun_again(daemon: DaemonFactory, town: Town) -> None:
    """Killed in the middle of all transfers, and back: the same bytes, and nothing in halves."""
    one = daemon(town.url, "--poll", "0")
    town.restart(SLOWLY)
    answers: list[Cells] = []
    asking = threading.Thread(target=ask_all, args=(one, answers))
    asking.start()
    try:
        until(lambda: town.nginx.connections())
        town.nginx.kill()
        with shmmap.connect(one.endpoint) as client:
            until(lambda: client.area(ALL, wait=5.0).failed)
            kept = [path for path in Path(one.cache_dir).rglob("objects/cells/*/*") if path.is_file()]
            assert kept == [], "nothing of an interrupted transfer is kept"
            town.restart()
            assert loaded(all_cells(client)) == of_files(town.files)
    finally:
        asking.join()
    assert set().union(*answers) <= of_files(town.files).keys()
