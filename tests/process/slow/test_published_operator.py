# SPDX-License-Identifier: Apache-2.0
"""What operators see of a published map: counters, screens, metrics; none of it for a map of files."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap, publish
from tests.support.daemon_process import DaemonProcess, Deadline, counters
from tests.support.divided_map import make_map
from tests.support.published_daemon import ALL, flip, until, until_taken
from tests.support.web_servers import FaultyWeb, faulty_web

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

CELLS = PAGES = 4


@pytest.fixture
def web(tmp_path: Path) -> Iterator[FaultyWeb]:
    """A web server of a published map of four cells, each in a shard of its own."""
    made = make_map(tmp_path / "town", columns=2, rows=2, points=300)
    publish(made.root, tmp_path / "www")
    with faulty_web(tmp_path / "www") as one:
        yield one


def counts_when(one: DaemonProcess, is_so: Callable[[Mapping[str, int]], bool]) -> Mapping[str, int]:
    """Wait for counters of which ``is_so`` is true; returns them."""
    until(lambda: is_so(counters(one)))
    return counters(one)


def load_all(one: DaemonProcess) -> shmmap.CellSet:
    with shmmap.connect(one.endpoint) as client:
        return client.area(ALL, wait=60.0)


def evict_all(one: DaemonProcess, client: shmmap.Client) -> None:
    """Evict all cells, and wait until none could be reused."""
    client.evict()
    counts_when(one, lambda counts: not counts["cells_resident"] and not counts["zombies"])


def objects(web: FaultyWeb) -> list[Path]:
    return [path for path in (web.folder / "blobs").rglob("*") if path.is_file()]


def test_what_is_fetched_and_what_is_on_the_disk(daemon: DaemonFactory, web: FaultyWeb) -> None:
    began_ns = time.time_ns()
    one = daemon(web.url, "--poll", "0")
    assert load_all(one).complete
    sizes = [path.stat().st_size for path in objects(web)]
    assert len(sizes) == CELLS + PAGES + 1
    counts = counts_when(one, lambda counts: counts["objects_fetched"] == len(sizes))
    assert counts["bytes_fetched"] == sum(sizes)
    assert (counts["objects_from_disk"], counts["fetches_failed"]) == (0, 0)
    assert counts["published_version"] == 1
    assert (counts["published_refused"], counts["published_expires_unix_ns"]) == (0, 0)
    assert began_ns < counts["published_taken_unix_ns"] < time.time_ns()
    assert (counts["map_pages"], counts["map_pages_known"], counts["map_cells_known"]) == (
        PAGES,
        PAGES,
        CELLS,
    )
    taken_ns = counts["published_taken_unix_ns"]
    until_taken(one)

    one.stop()
    one.start()
    assert load_all(one).complete
    counts = counts_when(
        one, lambda counts: counts["objects_from_disk"] == CELLS + PAGES
    )  # the root is state
    assert (counts["objects_fetched"], counts["published_taken_unix_ns"]) == (0, taken_ns)


def test_damage_and_failures_are_counted(daemon: DaemonFactory, web: FaultyWeb) -> None:
    one = daemon(web.url, "--poll", "0")
    assert load_all(one).complete
    kept = [path for path in Path(one.cache_dir).rglob("objects/cells/*/*") if path.is_file()]
    assert len(kept) == CELLS
    one.stop()
    flip(kept[0])
    kept[1].unlink()
    lost = kept[1].name
    web.fault = lambda path: "corrupt" if path.endswith(lost) else ""
    one.start()
    cells = load_all(one)
    assert len(cells.failed) == 1
    # the store is asked twice
    wanted = {"objects_damaged_in_store": 2, "objects_damaged_on_disk": 1, "fetches_failed": 2}
    counts_when(one, lambda counts: wanted.items() <= counts.items())

    before_ns = time.time_ns()
    web.refuse()
    with shmmap.connect(one.endpoint) as client:
        until(lambda: [failure.code for failure in client.area(ALL, wait=5.0).failed] == ["offline"])
    counts = counts_when(one, lambda counts: counts["origin_out"] == 1 and counts["fetches_failed"] > 2)
    assert before_ns < counts["origin_out_since_unix_ns"] < time.time_ns()
    web.listen()
    counts = counts_when(one, lambda counts: counts["origin_out"] == 0)
    assert counts["origin_out_since_unix_ns"] == 0


def test_screens_say_it(daemon: DaemonFactory, web: FaultyWeb, tmp_path: Path) -> None:
    one = daemon(web.url, "--poll", "0")
    assert load_all(one).complete
    counts_when(one, lambda counts: counts["objects_fetched"] == CELLS + PAGES + 1)
    shmmap_ = Shmmap(one, tmp_path)
    shown: dict[str, Any] = shmmap_.json("status")["published"]
    assert shmmap_.json("top")["published"].keys() == shown.keys()
    assert (shown["version"], shown["objects_fetched"], shown["cells_known"]) == (1, CELLS + PAGES + 1, CELLS)
    assert shown["expires_unix_s"] is shown["offline_since_unix_s"] is shown["refused"] is None
    assert abs(shown["taken_unix_s"] - time.time()) < 240
    status, top = shmmap_("status"), " ".join(shmmap_("top", "--once").split())
    assert re.search(r"^version +1, taken on \d{4}-\d\d-\d\d \d\d:\d\d UTC, .* ago$", status, re.MULTILINE)
    assert re.search(r"^known +all 4 cells$", status, re.MULTILINE)
    fetched = re.search(
        r"^fetched +(9 objects, [\d.]+ KiB; from the disk 0 objects, 0 B)$", status, re.MULTILINE
    )
    assert fetched is not None
    assert fetched[1] in top
    assert "version 1, taken on" in " ".join(shmmap_("map").split())
    metrics = shmmap_("metrics")
    assert re.search(r"^shmmap_objects_fetched_total\{.*\} 9$", metrics, re.MULTILINE)
    assert re.search(r"^shmmap_published_version\{.*\} 1$", metrics, re.MULTILINE)
    assert re.search(r"^shmmap_published_taken_timestamp_seconds\{", metrics, re.MULTILINE)
    assert "shmmap_published_expires" not in metrics
    assert "shmmap_origin_out_since" not in metrics

    web.refuse()
    with shmmap.connect(one.endpoint) as client:
        evict_all(one, client)
        assert client.area(ALL, wait=60.0).complete, "out of the disk cache"
    shutil.rmtree(one.cache_dir)
    with shmmap.connect(one.endpoint) as client:
        evict_all(one, client)
        waiting = Deadline()
        while waiting(len(client.area(ALL, wait=5.0).failed) != CELLS):
            evict_all(one, client)  # the counters were of before, and what was evicted was used again
    counts_when(one, lambda counts: counts["origin_out"] == 1)
    assert re.search(
        r"^origin +out of reach for .* \(since .* UTC\): what is in memory and on", shmmap_("status"), re.M
    )
    assert "its store is out of reach for" in " ".join(shmmap_("map").split())
    assert shmmap_.json("status")["published"]["offline_since_unix_s"] <= time.time()
    assert re.search(r"^shmmap_origin_out_since_timestamp_seconds\{.*\} 1", shmmap_("metrics"), re.MULTILINE)


def test_nothing_of_it_where_the_map_is_files(daemon: DaemonFactory, tmp_path: Path) -> None:
    made = make_map(tmp_path / "town", columns=2, rows=2, points=300)
    one = daemon(made.root)
    assert load_all(one).complete
    shmmap_ = Shmmap(one, tmp_path)
    assert shmmap_.json("status")["published"] is None
    assert shmmap_.json("top")["published"] is None
    for text in (shmmap_("status"), shmmap_("top", "--once"), shmmap_("map")):
        assert "taken on" not in text
        assert "fetched  " not in text
    metrics = shmmap_("metrics")
    assert not re.search("shmmap_(objects|published|fetches|map_pages)", metrics)
    assert "shmmap_map_cells_known" in metrics
