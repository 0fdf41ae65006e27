# SPDX-License-Identifier: Apache-2.0
"""What a loader's processor does to fetch a window of cells, against the bare parts of it, in turns.

    python -m tests.benchmarks.serve_published [--map DIR] [--repeats 11]

Bare: get, SHA-256, unpack, and write into shared memory as a segment, of the same objects from the same web
server (a process of its own), in as many threads.  Limit: 1.25 of that, least over least.
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

from shmmap.daemon.loading.published_reader import AT_ONCE, PublishedReader
from shmmap.layers.derive import CellJob
from shmmap.layers.making import make_layer
from shmmap.layers.spec import layer_spec
from shmmap.origin.remote.map_versions import read_current, read_root, read_shards
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.published_index import POINTS, Root, Shard
from shmmap.origin.remote.published_object import CellIdentity, ObjectName, write_segment
from shmmap.origin.remote.published_source import LayerSource, pack_source
from shmmap.origin.remote.serving_store import ServedFrom
from shmmap.origin.remote.zstd_frame import unpack_frame
from tests.support.divided_map import make_map
from tests.support.publishing import publish

LIMIT = 1.25
SERVER = """
import functools, http.server, sys
http.server.SimpleHTTPRequestHandler.log_message = lambda *_: None
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

    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(one, cells))


def loader(url: str, jobs: list[CellJob]) -> None:
    """Do as a loader does."""
    reader, spec = PublishedReader(ServedFrom(url), "", 0), layer_spec(POINTS)
    waiting = dict(enumerate(jobs, start=1))
    for number, job in waiting.items():
        reader.fetcher.begin(number, spec, job)
    while waiting:
        select.select([reader.fetcher.fd], [], [])
        done = reader.fetcher.done()
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--map", type=Path)
    parser.add_argument("--repeats", type=int, default=11)
    args = parser.parse_args()
    data = os.environ.get("SHMMAP_TEST_DATA", "")
    with tempfile.TemporaryDirectory() as folder:
        source = args.map or (Path(data, "kitti0005_map/map_static_v005.pcd") if data else None)
        if source is None:
            source = make_map(Path(folder, "map"), points=40_000).root
        if source.is_file():
            divided = Path(folder, "divided")
            divide = [sys.executable, "-m", "shmmap.cli", "divide", str(source), str(divided), "--quiet"]
            subprocess.run(divide, check=True)
            source = divided
        publish(source, f"{folder}/www")
        command = [sys.executable, "-c", SERVER, f"{folder}/www"]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            url = f"http://127.0.0.1:{int(server.stdout.readline())}"
            store = open_store(url)
            current = read_current(store).current
            assert current is not None
            root = read_root(store, current)
            cells, jobs = window(root, list(read_shards(store, root)))
            least = {"bare": (1e9, 1e9), "loader": (1e9, 1e9)}
            for _ in range(args.repeats):
                for name in least:
                    cpu, wall = time.process_time(), time.perf_counter()
                    bare(url, cells) if name == "bare" else loader(url, jobs)
                    spent = time.process_time() - cpu, time.perf_counter() - wall
                    least[name] = min(least[name][0], spent[0]), min(least[name][1], spent[1])
        finally:
            server.kill()
            server.wait()
    nbytes = sum(name.size for name, _ in cells)
    print(f"{len(cells)} cells, {nbytes / 1e6:.1f} MB of objects")
    for name, (cpu, wall) in least.items():
        print(f"{name:8} processor {1e3 * cpu:7.1f} ms   wall {1e3 * wall:7.1f} ms")
    ratio = least["loader"][0] / least["bare"][0]
    print(f"loader / bare, processor: {ratio:.2f} (limit {LIMIT})")
    return int(ratio > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
