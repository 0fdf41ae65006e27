# SPDX-License-Identifier: Apache-2.0
"""What a loader's processor does to fetch a window of cells, against the bare parts of it, in turns.

    python -m tests.benchmarks.serve_published [--map DIR] [--repeats 11]
    python -m tests.benchmarks.serve_published --link [--map DIR] [--repeats 3] [--lift]

Bare: get, SHA-256, unpack, and write into shared memory as a segment, of the same objects from the same web
server (a process of its own), in as many threads.  Limit: 1.25 of that, least over least.

With ``--link``: how long a first window takes over 20 Mbit/s and 50 ms there and back, from when a new daemon
with an empty disk is ready until a client has all cells.  Beside it, in turns, nothing but gets of the same
objects over the same link, in as many threads.  Limits: points 1.08 of that; `ndt` layers 0.48 s more than
their bytes take, which is 0.7 s for those of the recorded street.  The least of the rounds counts; of `ndt`
layers there are three times as many.
"""

from __future__ import annotations

import argparse
import os
import select
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path

import obstore
from obstore.store import HTTPStore

import shmmap
from shmmap.daemon.loading.published_reader import CONCURRENT_FETCHES, PublishedReader
from shmmap.layers.build import make_layer
from shmmap.layers.sources import CellJob
from shmmap.layers.spec import layer_spec
from shmmap.origin.remote.map_versions import read_current, read_root, read_shards
from shmmap.origin.remote.opened_store import ServedFrom, open_store
from shmmap.origin.remote.published_index import Root, Shard
from shmmap.origin.remote.published_object import (
    POINTS,
    CellIdentity,
    LayerSource,
    ObjectName,
    pack_source,
    write_segment,
)
from shmmap.origin.remote.zstd_frame import unpack_frame
from tests.benchmarks.hostile.stage import lift
from tests.support.command_line import publish
from tests.support.daemon_process import DaemonProcess, LineProcess
from tests.support.divided_map import Box, make_map
from tests.support.slow_link import Plan, slow_link

LIMIT = 1.25
NDT = "ndt(leaf=2.0)"
LINK_MBIT_S, LINK_DELAY_S = 20.0, 0.025
LINK_LIMIT, NDT_LIMIT_S = 1.08, 0.48
SERVER = """
import functools, http.server, sys
http.server.SimpleHTTPRequestHandler.log_message = lambda *_: None
http.server.SimpleHTTPRequestHandler.protocol_version = "HTTP/1.1"
http.server.SimpleHTTPRequestHandler.disable_nagle_algorithm = True
http.server.ThreadingHTTPServer.request_queue_size = 128
handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=sys.argv[1])
server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
print(server.server_port, flush=True)
server.serve_forever()
"""


def segment_file() -> int:
    return os.open("/dev/shm", os.O_TMPFILE | os.O_RDWR, 0o600)


def bare(url: str, cells: list[tuple[ObjectName, CellIdentity]]) -> None:
    """Get, compare, unpack and write, nothing else."""
    store = HTTPStore.from_url(url, client_options={"allow_http": True})

    def one(cell: tuple[ObjectName, CellIdentity]) -> None:
        name, identity = cell
        frame = memoryview(obstore.get(store, name.path).bytes())
        assert sha256(frame).digest() == name.sha256
        fd = segment_file()
        write_segment(unpack_frame(frame, name.raw, name="", exact=True), fd, identity, POINTS)
        os.close(fd)

    with ThreadPoolExecutor(CONCURRENT_FETCHES) as pool:
        list(pool.map(one, cells))


def loader(url: str, jobs: list[CellJob]) -> None:
    """Do as a loader does."""
    reader, spec = PublishedReader(ServedFrom(url), "", 0), layer_spec(POINTS)
    waiting = dict(enumerate(jobs, start=1))
    for number, job in waiting.items():
        reader.fetcher.begin(number, spec, job)
    while waiting:
        select.select([reader.fetcher.fd], [], [])
        done = reader.fetcher.take_done()
        if done is not None:
            job, fd = waiting.pop(done), segment_file()
            made = make_layer(spec, CellJob(job.cell_id, job.source, job.box, reader=reader, ready=1), fd)
            assert made.header.rows
            os.close(fd)


def window(root: Root, shards: list[Shard]) -> tuple[list[tuple[ObjectName, CellIdentity]], list[CellJob]]:
    """Objects and jobs of all cells."""
    cells, jobs = [], []
    for shard in shards:
        for row in range(len(shard)):
            name, identity = shard.layers[POINTS].name(row), shard.identity(row, root)
            source = pack_source(identity.cell_id, {POINTS: LayerSource(*name, root.layers[POINTS])})
            cells.append((name, identity))
            jobs.append(CellJob(identity.cell_id, source, identity.box))
    return cells, jobs


def gets(url: str, names: list[ObjectName]) -> None:
    """Get objects, nothing else."""
    store = HTTPStore.from_url(url, client_options={"allow_http": True})
    with ThreadPoolExecutor(CONCURRENT_FETCHES) as pool:
        sizes = list(pool.map(lambda name: len(obstore.get(store, name.path).bytes()), names))
    assert sizes == [name.size for name in names]


def first_window(url: str, bounds: Box, layer: str, count: int, *, lifted: bool) -> float:
    """Seconds from when a daemon is ready until a client has a layer of all cells."""
    with DaemonProcess(url) as one:
        if lifted:
            lift(one.pid)
        begin_s = time.perf_counter()
        with shmmap.connect(one.endpoint) as client:
            found = client.area(shmmap.Box(*bounds), (layer,), wait=300.0)
            took_s = time.perf_counter() - begin_s
            assert len(found.cells) == count
    return took_s


def over_link(port: int, root: Root, shards: list[Shard], repeats: int, *, lifted: bool) -> int:
    """Compare first windows over a link with gets, and print."""
    held = True
    for layer in (POINTS, NDT):
        names = [shard.layers[layer].name(row) for shard in shards for row in range(len(shard))]
        least = {"gets": 1e9, "daemon": 1e9}
        with slow_link(Plan(port, LINK_MBIT_S, LINK_DELAY_S)) as link:
            for _ in range(repeats if layer == POINTS else 3 * repeats):
                begin_s = time.perf_counter()
                gets(link.endpoint, names)
                least["gets"] = min(least["gets"], time.perf_counter() - begin_s)
                took_s = first_window(link.endpoint, root.bounds, layer, len(names), lifted=lifted)
                least["daemon"] = min(least["daemon"], took_s)
        mb = sum(name.size for name in names) / 1e6
        bytes_s, ratio = mb * 8 / LINK_MBIT_S, least["daemon"] / least["gets"]
        limit_s = LINK_LIMIT * least["gets"] if layer == POINTS else bytes_s + NDT_LIMIT_S
        held &= least["daemon"] <= limit_s
        print(
            f"{layer:13} {len(names)} objects, {mb:.2f} MB, which take {bytes_s:.2f} s:"
            f" gets {least['gets']:.2f} s, daemon {least['daemon']:.2f} s, {ratio:.3f} of it"
            f" (limit {limit_s:.2f} s)",
            flush=True,
        )
    print(f"load {os.getloadavg()[0]:.1f}; limits {'held' if held else 'NOT HELD'}")
    return int(not held)


def processors(url: str, root: Root, shards: list[Shard], repeats: int) -> int:
    """Compare a loader's processor time with that of the bare parts, and print."""
    cells, jobs = window(root, shards)
    least = {"bare": (1e9, 1e9), "loader": (1e9, 1e9)}
    for _ in range(repeats):
        for name in least:
            cpu, wall = time.process_time(), time.perf_counter()
            bare(url, cells) if name == "bare" else loader(url, jobs)
            spent = time.process_time() - cpu, time.perf_counter() - wall
            least[name] = min(least[name][0], spent[0]), min(least[name][1], spent[1])
    nbytes = sum(name.size for name, _ in cells)
    print(f"{len(cells)} cells, {nbytes / 1e6:.1f} MB of objects")
    for name, (cpu, wall) in least.items():
        print(f"{name:8} processor {1e3 * cpu:7.1f} ms   wall {1e3 * wall:7.1f} ms")
    ratio = least["loader"][0] / least["bare"][0]
    print(f"loader / bare, processor: {ratio:.2f} (limit {LIMIT})")
    return int(ratio > LIMIT)


def map_to_publish(given: Path | None, folder: Path) -> Path:
    """Return the given map, else the street's, else a made one; a cloud is divided first."""
    data = os.environ.get("SHMMAP_TEST_DATA", "")
    source = given or (Path(data, "kitti0005_map/map_static_v005.pcd") if data else None)
    if source is None:
        return make_map(folder / "map", points=40_000).root
    if source.is_dir():
        return source
    divided = folder / "divided"
    divide = [sys.executable, "-m", "shmmap.cli", "divide", str(source), str(divided), "--quiet"]
    subprocess.run(divide, check=True)
    return divided


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--map", type=Path)
    parser.add_argument("--repeats", type=int)
    parser.add_argument("--link", action="store_true", help="first windows over a slow link")
    parser.add_argument("--lift", action="store_true", help="go before unrelated work (needs root)")
    args = parser.parse_args()
    if args.lift:
        lift(os.getpid())
    with tempfile.TemporaryDirectory() as folder:
        layers = ("--layer", NDT) if args.link else ()
        publish(map_to_publish(args.map, Path(folder)), f"{folder}/www", *layers)
        with LineProcess(sys.executable, "-c", SERVER, f"{folder}/www") as server:
            port = int(server.read())
            url = f"http://127.0.0.1:{port}"
            store = open_store(url)
            current = read_current(store).current
            assert current is not None
            root = read_root(store, current)
            shards = list(read_shards(store, root))
            if args.link:
                return over_link(port, root, shards, args.repeats or 3, lifted=args.lift)
            return processors(url, root, shards, args.repeats or 11)


if __name__ == "__main__":
    sys.exit(main())
