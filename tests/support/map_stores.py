# SPDX-License-Identifier: Apache-2.0
"""Stores of published maps on this machine: moto's S3 server, a whole Ceph, a web server, memory.

``python -m tests.support.map_stores LOG`` prints the port of an S3 server.  A line of LOG is
``METHOD PATH STATUS BYTES``.
"""

from __future__ import annotations

import contextlib
import functools
import http.server
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import urllib.error
import urllib.request
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import pytest

from shmmap.errors import Offline
from tests.support.command_line import Verbs
from tests.support.compiled_programs import made_once
from tests.support.daemon_process import Deadline, LineProcess, until
from tests.support.divided_map import make_map


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


# Moto's S3 server on loopback, in a process of its own, which writes down what is asked of it


BUCKET = "maps"
KEYS = {
    "AWS_ACCESS_KEY_ID": "of-the-tests",
    "AWS_SECRET_ACCESS_KEY": "a-secret-of-the-tests",
    "AWS_REGION": "us-east-1",
}
"""Credentials are always given: without any, a library might ask the cloud's metadata address."""


class BucketServer:
    """A running server."""

    def __init__(self, port: int, log: Path) -> None:
        self.endpoint = f"http://127.0.0.1:{port}"
        self.environment = {**KEYS, "AWS_ENDPOINT_URL": self.endpoint}
        self._log = log
        self._seen = 0

    def url(self, name: str) -> str:
        """URL of a map in the bucket."""
        return f"s3://{BUCKET}/{name}"

    def requests(self) -> list[tuple[str, str, int, int]]:
        """What was asked since the last call: method, path, status, and bytes received."""
        lines = self._log.read_text().splitlines()
        new, self._seen = lines[self._seen :], len(lines)
        return [(m, p, int(s), int(n)) for m, p, s, n in (line.split(" ") for line in new)]

    def received(self) -> list[str]:
        """Paths of the objects that were written since the last call; not what the store was asked with."""
        return [
            path
            for method, path, status, _ in self.requests()
            if method == "PUT" and status < 300 and not path.endswith("/conditions.json")
        ]


@contextmanager
def bucket_server(folder: Path) -> Iterator[BucketServer]:
    """Run a server until the end of the block."""
    log = folder / "requests.log"
    log.touch()
    command = [sys.executable, "-W", "ignore", "-m", "tests.support.map_stores", str(log)]
    with LineProcess(*command) as process:
        server = BucketServer(int(process.read()), log)
        urllib.request.urlopen(
            urllib.request.Request(f"{server.endpoint}/{BUCKET}", method="PUT"), timeout=30
        ).close()
        yield server


def main() -> None:
    """Serve until stdin is closed."""
    import logging
    import threading

    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    inner: Any = DomainDispatcherApplication(create_backend_app)
    changing = threading.Lock()  # a store compares and switches in one step, moto in two

    with open(sys.argv[1], "a", buffering=1, encoding="utf-8") as log:

        def written_down(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
            def respond(status: str, headers: Any, *more: Any) -> Any:
                size = environ.get("CONTENT_LENGTH") or "0"
                log.write(f"{environ['REQUEST_METHOD']} {environ['PATH_INFO']} {status[:3]} {size}\n")
                return start_response(status, headers, *more)

            with contextlib.nullcontext() if environ["REQUEST_METHOD"] in ("GET", "HEAD") else changing:
                answer: Iterable[bytes] = inner(environ, respond)
            return answer

        server = make_server("127.0.0.1", 0, written_down, threaded=True)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        print(server.port, flush=True)
        sys.stdin.read()


# A whole Ceph on loopback: a monitor, a manager, three disks with every object on each, and its S3 gateway


CEPH_PROGRAMS: Final = ("ceph", "ceph-mon", "ceph-mgr", "ceph-osd", "radosgw", "radosgw-admin")
_DISKS: Final = (0, 1, 2)
_CAPS: Final = {
    "mon.": {"mon": "allow *"},
    "client.admin": {"mon": "allow *", "osd": "allow *", "mgr": "allow *"},
    "client.rgw": {"mon": "allow *", "osd": "allow *", "mgr": "allow *"},
    "mgr.x": {"mon": "allow profile mgr", "osd": "allow *"},
    **{
        f"osd.{n}": {"mon": "allow profile osd", "mgr": "allow profile osd", "osd": "allow *"} for n in _DISKS
    },
}
_SETTINGS: Final = """
[global]
fsid = {fsid}
mon_host = [v2:127.0.0.1:{v2},v1:127.0.0.1:{v1}]
public_addr = 127.0.0.1
cluster_addr = 127.0.0.1
keyring = {folder}/keyring
run_dir = {folder}
admin_socket = {folder}/$name.asok
log_file = {folder}/$name.log
mon_data = {folder}/mon
mgr_data = {folder}/mgr
osd_data = {folder}/osd.$id
crash_dir = {folder}
bluestore_block_size = 4294967296
osd_crush_chooseleaf_type = 0
osd_pool_default_size = 3
osd_pool_default_min_size = 2
osd_pool_default_pg_num = 8
osd_pool_default_pg_autoscale_mode = off
osd_heartbeat_grace = 5
mon_osd_reporter_subtree_level = osd
mon_max_pg_per_osd = 1000
mon_data_avail_warn = 1
mon_data_avail_crit = 1
debug_rgw = 1
"""
_ACCESS: Final = re.compile(r' beast: .*\] "(\S+) (\S+) HTTP/[\d.]+" (\d+) ')


class CephServer(BucketServer):
    """A running cluster, asked by its gateway."""

    def __init__(self, folder: Path, port: int) -> None:
        super().__init__(port, folder / "client.rgw.log")
        self._folder = folder
        self._port = port
        self._daemons: dict[str, subprocess.Popen[bytes]] = {}
        self._marks = 0

    def requests(self) -> list[tuple[str, str, int, int]]:
        """Requests since the last call: method, path, status, and 0: its log has no sizes."""
        mark = f"/mark-{self._marks}"
        self._marks += 1
        with suppress(urllib.error.HTTPError):
            urllib.request.urlopen(self.endpoint + mark, timeout=60).close()
        waiting = Deadline()
        while waiting(mark not in (text := self._log.read_text())):
            pass
        found = _ACCESS.findall(text)
        new, self._seen = found[self._seen :], len(found)
        return [
            (method, path.partition("?")[0], int(status), 0) for method, path, status in new if path != mark
        ]

    def run(self, *words: str) -> str:
        """Run one of Ceph's programs for this cluster; returns what it prints."""
        return subprocess.run(
            [words[0], "-c", str(self._folder / "ceph.conf"), *words[1:]],
            check=True,
            capture_output=True,
            text=True,
            timeout=300,
        ).stdout

    def start(self, name: str) -> None:
        """Start a daemon: ``mon.a``, ``mgr.x``, ``osd.0`` to ``osd.2``, or the gateway ``client.rgw``."""
        kind, _, number = name.partition(".")
        words = (
            ["radosgw", "-n", name, "--rgw_frontends", f"beast endpoint=127.0.0.1:{self._port} tcp_nodelay=1"]
            if kind == "client"
            else [f"ceph-{kind}", "-i", number]
        )
        with open(self._folder / f"{name}.out", "ab") as out:
            self._daemons[name] = subprocess.Popen(
                [*words, "-c", str(self._folder / "ceph.conf"), "-f"],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
            )

    def kill(self, name: str) -> None:
        """End a daemon by SIGKILL."""
        process = self._daemons.pop(name)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def repair(self) -> None:
        """Start the daemons that were killed, and wait until all serve."""
        for name in ("client.rgw", *(f"osd.{number}" for number in _DISKS)):
            if name not in self._daemons:
                self.start(name)
        self.wait_for_disks(len(_DISKS))
        self.wait_for_gateway()

    def wait_for_disks(self, up: int) -> None:
        """Wait until this number of disks is up."""
        until(lambda: f" {up} up" in self.run("ceph", "osd", "stat"))

    def wait_for_gateway(self) -> None:
        """Wait until the gateway answers."""
        waiting = Deadline()
        while waiting(not _answers(self._port)):
            assert self._daemons["client.rgw"].poll() is None, (self._folder / "client.rgw.out").read_text()

    def close(self) -> None:
        """End all daemons."""
        for name in list(self._daemons):
            self.kill(name)


@contextmanager
def ceph_server() -> Iterator[CephServer]:
    """Run a cluster until the end of the block, in a directory that goes with it."""
    folder = Path(tempfile.mkdtemp(prefix="ceph-"))  # its sockets' paths must be short
    v1, v2, port = _free_ports(3)
    server = CephServer(folder, port)
    try:
        _make(server, folder, v1=v1, v2=v2)
        yield server
    finally:
        server.close()
        shutil.rmtree(folder)


def _make(server: CephServer, folder: Path, *, v1: int, v2: int) -> None:
    fsid = str(uuid.uuid4())
    (folder / "ceph.conf").write_text(_SETTINGS.format(folder=folder, fsid=fsid, v1=v1, v2=v2))
    keyring, monmap = str(folder / "keyring"), str(folder / "monmap")
    for name, caps in _CAPS.items():
        words = [word for service, cap in caps.items() for word in ("--cap", service, cap)]
        create = [] if (folder / "keyring").exists() else ["--create-keyring"]
        subprocess.run(
            ["ceph-authtool", *create, keyring, "--gen-key", "-n", name, *words],
            check=True,
            capture_output=True,
        )
    address = f"[v2:127.0.0.1:{v2},v1:127.0.0.1:{v1}]"
    subprocess.run(
        ["monmaptool", "--create", "--fsid", fsid, "--addv", "a", address, monmap],
        check=True,
        capture_output=True,
    )
    for place in ("mon", "mgr"):
        (folder / place).mkdir()
    server.run("ceph-mon", "--mkfs", "-i", "a", "--monmap", monmap, "--keyring", keyring)
    shutil.copy(keyring, folder / "mon/keyring")
    server.start("mon.a")
    server.start("mgr.x")
    for number in _DISKS:
        (folder / f"osd.{number}").mkdir()
        disk = str(uuid.uuid4())
        server.run("ceph", "osd", "new", disk, str(number))
        server.run("ceph-osd", "-i", str(number), "--mkfs", "--osd-uuid", disk)
        server.start(f"osd.{number}")
    server.wait_for_disks(len(_DISKS))
    server.start("client.rgw")
    server.wait_for_gateway()
    server.run(
        "radosgw-admin",
        "-n",
        "client.rgw",
        "user",
        "create",
        "--uid",
        "tests",
        "--display-name",
        "tests",
        "--access-key",
        KEYS["AWS_ACCESS_KEY_ID"],
        "--secret-key",
        KEYS["AWS_SECRET_ACCESS_KEY"],
    )
    import boto3

    boto3.client(
        "s3",
        endpoint_url=server.endpoint,
        region_name=KEYS["AWS_REGION"],
        aws_access_key_id=KEYS["AWS_ACCESS_KEY_ID"],
        aws_secret_access_key=KEYS["AWS_SECRET_ACCESS_KEY"],
    ).create_bucket(Bucket=BUCKET)


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


def _answers(port: int) -> bool:
    try:
        urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5).close()
    except urllib.error.HTTPError:
        return True
    except OSError:
        return False
    return True


# Waits until a disk tier of this process has trimmed what it keeps


def wait_for_trimming() -> None:
    """Join the threads that trim."""
    for thread in threading.enumerate():
        if thread.name == "trim":
            thread.join()


if __name__ == "__main__":
    main()


@pytest.fixture(scope="session")
def signed_maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One map of two cells, signed: with versions 1 and 2, another version 2, and signed by others.

    Directories ``one``, ``two``, ``equal``, ``other``; their ``keys`` and ``others``; ``town`` has the files.
    """
    return made_once(tmp_path_factory, "signed", _make_signed_maps)


def _make_signed_maps(folder: Path) -> None:
    from tests.support.published_maps import Signed

    made = make_map(folder / "town", columns=2, rows=1, points=100)
    run = Verbs(folder)
    run("publish", made.root, folder / "one", "--sign", folder / "keys", "--id-prefix", "/town/")
    shutil.copytree(folder / "one", folder / "two")
    shutil.copytree(folder / "one", folder / "equal")
    made.change("0_0.pcd", seed=1)
    run("publish", made.root, folder / "two", "--sign", folder / "keys")
    run("publish", made.root, folder / "other", "--sign", folder / "others", "--id-prefix", "/town/")
    made.change("0_0.pcd", seed=2)
    run("publish", made.root, folder / "equal", "--sign", folder / "keys")
    Signed(folder / "equal", folder / "keys").write_all(3)  # newer than the other version 2


class MemoryStore:
    """Objects in memory, which can be held back, or out of reach."""

    url = "memory:"

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}
        self.open = threading.Event()
        self.open.set()
        self.is_out = False
        self.asked: list[str] = []

    def get_exactly(self, path: str, nbytes: int) -> memoryview:
        self.asked.append(path)
        assert self.open.wait(60.0)
        if self.is_out:
            raise Offline("no answer")
        data = self.objects[path]
        assert len(data) == nbytes
        return memoryview(data)

    def add(self, data: bytes) -> bytes:
        """Add an object; returns its SHA-256."""
        digest = sha256(data).digest()
        self.objects[f"blobs/sha256/{digest.hex()}"] = data
        return digest
