# SPDX-License-Identifier: Apache-2.0
"""`shmmap doctor` beside daemons of published maps: link, credentials, clock, versions."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.accounts import OTHER_USER
from tests.support.command_line import doctor, publish
from tests.support.compiled_programs import built_preload
from tests.support.daemon_process import ROOT, DaemonProcess, Deadline
from tests.support.divided_map import make_map
from tests.support.map_stores import KEYS, BucketServer
from tests.support.web_servers import FaultyWeb, faulty_web

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

ROWS = ("link", "credentials", "clock", "versions")
TOWN = "maps/town"


@pytest.fixture
def web(tmp_path: Path) -> Iterator[FaultyWeb]:
    """A web server that has a published map below the path of a bucket."""
    made = make_map(tmp_path / "files", columns=2, rows=2, points=300)
    publish(made.root, tmp_path / "www" / TOWN)
    with faulty_web(tmp_path / "www") as one:
        yield one


def rows(one: DaemonProcess) -> dict[str, Any]:
    _code, found = doctor(one)
    return {name: found[name] for name in ROWS}


def states(found: dict[str, Any]) -> list[str]:
    return ["skip" if found[name]["skipped"] else found[name]["state"] for name in ROWS]


def until_row(one: DaemonProcess, name: str, text: str) -> dict[str, Any]:
    waiting = Deadline()
    while waiting(text not in (found := rows(one))[name]["fact"]):
        pass
    return found


def test_a_web_server_that_answers(daemon: DaemonFactory, web: FaultyWeb) -> None:
    one = daemon(f"{web.url}/{TOWN}", "--poll", "0")
    found = until_row(one, "versions", "is served")
    assert states(found) == ["ok", "skip", "ok", "ok"]
    assert found["link"]["fact"].startswith(f"{web.url}/{TOWN} answers: ")
    assert found["versions"]["fact"].startswith("version 1 of 20")
    assert found["versions"]["fact"].endswith("it is what is offered")

    web.clock_ahead_s = 7200.0
    assert "behind the store's" in rows(one)["clock"]["fact"]
    web.clock_ahead_s = -7200.0
    found = rows(one)
    assert (found["clock"]["state"], "ahead of the store's" in found["clock"]["fact"]) == ("warn", True)
    web.clock_ahead_s = 0.0

    published = web.folder / TOWN
    (published / "CURRENT").write_text(
        (published / "CURRENT").read_text().replace('"version": 1', '"version": 5')
    )
    found = rows(one)
    assert found["versions"]["state"] == "ok"
    assert "version 5 is offered" in found["versions"]["fact"]

    web.refuse()
    found = rows(one)
    assert states(found)[0] == "warn"
    assert "no answer; the daemon reached it when it last asked" in found["link"]["fact"]
    shutil.rmtree(one.cache_dir, ignore_errors=True)
    with shmmap.connect(one.endpoint) as client:
        assert client.around(0.0, 0.0, 50.0, wait=60.0).failed
    found = until_row(one, "link", "the daemon has not reached it for ")
    assert found["link"]["advice"]


def test_an_older_offer(daemon: DaemonFactory, web: FaultyWeb, tmp_path: Path) -> None:
    current = web.folder / TOWN / "CURRENT"
    first = current.read_bytes()
    other = make_map(tmp_path / "other", columns=2, rows=2, points=200)
    publish(other.root, web.folder / TOWN)
    one = daemon(f"{web.url}/{TOWN}", "--poll", "0")
    until_row(one, "versions", "version 2")
    current.write_bytes(first)
    found = rows(one)["versions"]
    assert (found["state"], "version 1 of 20" in found["fact"], "older" in found["fact"]) == (
        "warn",
        True,
        True,
    )
    assert "--accept-version 1" in found["advice"]
    with shmmap.connect(one.endpoint) as client, suppress(shmmap.ShmmapError):
        client.reload()
    found = until_row(one, "versions", "version 1, which is offered, is refused, older")
    assert found["versions"]["state"] == "warn"


def test_without_a_daemon_the_configured_url_is_asked(
    daemon: DaemonFactory, web: FaultyWeb, tmp_path: Path
) -> None:
    one = daemon(f"{web.url}/{TOWN}", start=False)
    file = tmp_path / "shmmap.toml"
    file.write_text(f'map_path = "{web.url}/{TOWN}"\n')
    found = doctor(one, "--config", str(file))[1]
    assert (found["link"]["state"], found["versions"]["fact"][:9]) == ("ok", "version 1")
    file.write_text(f'map_path = "{web.url}/elsewhere"\n')
    found = doctor(one, "--config", str(file))[1]
    assert "no map is published there" in found["link"]["fact"]


def test_a_server_that_sends_a_byte_now_and_then_does_not_hang_it(
    daemon: DaemonFactory, tmp_path: Path
) -> None:
    ended = threading.Event()

    def trickle(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            connection.recv(1 << 16)
            connection.sendall(b'HTTP/1.1 200 OK\r\nContent-Length: 1000\r\nETag: "1"\r\n\r\n')
            while not ended.wait(0.5):
                connection.sendall(b" ")

    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with suppress(OSError):
                while True:
                    threading.Thread(target=trickle, args=(server.accept()[0],)).start()

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            file = tmp_path / "shmmap.toml"
            file.write_text(f'map_path = "http://127.0.0.1:{server.getsockname()[1]}/town"\n')
            found = doctor(daemon("", start=False), "--config", str(file))[1]["link"]
        finally:
            ended.set()
            server.shutdown(socket.SHUT_RDWR)
            thread.join()
    assert found["state"] == "warn"
    assert "the answer was not complete within 4 s" in found["fact"]


@pytest.fixture
def bucket(web: FaultyWeb, daemon: DaemonFactory, monkeypatch: pytest.MonkeyPatch) -> DaemonProcess:
    """A daemon of the web server as an S3 server, with keys in its environment alone."""
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    return daemon(f"s3://{TOWN}", "--poll", "0", environment={**KEYS, "AWS_ENDPOINT_URL": web.url})


def test_credentials_are_named_and_never_shown(bucket: DaemonProcess, web: FaultyWeb) -> None:
    found = until_row(bucket, "versions", "is served")
    assert states(found) == ["ok"] * 4
    assert found["credentials"]["fact"] == "from the environment, AWS_ACCESS_KEY_ID; the store takes them"
    web.fault = lambda _path: "400 ExpiredToken"
    found = rows(bucket)
    assert (found["credentials"]["state"], found["link"]["state"]) == ("warn", "warn")
    assert found["credentials"]["fact"].endswith("refused, the credentials have expired")
    web.fault = lambda _path: "403 RequestTimeTooSkewed"
    assert "clock differs from the store's" in rows(bucket)["credentials"]["fact"]
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        assert KEYS[name] not in json.dumps(rows(bucket))


def test_credentials_that_cannot_be_used(bucket: DaemonProcess, web: FaultyWeb, tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text(f'map_path = "s3://{TOWN}"\n')
    until_row(bucket, "versions", "is served")
    bucket.stop()
    web.requests()
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "half of a pair")
        monkeypatch.setenv("AWS_ENDPOINT_URL", web.url)
        code, found = doctor(bucket, "--config", str(file))
        assert (code, found["credentials"]["state"], found["link"]["skipped"]) == (1, "fail", True)
        assert not web.requests()
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a key")
        monkeypatch.setenv("AWS_SESSION_TOKEN", "a token")
        monkeypatch.setenv("AWS_CREDENTIAL_EXPIRATION", "2026-01-01T00:00:00Z")
        found = doctor(bucket, "--config", str(file))[1]["credentials"]
        assert found["fact"].startswith("the credentials in the environment expired at 2026-01-01T00:00:00Z")
        assert "half of a pair" not in json.dumps(found)


def test_no_other_address_is_asked(
    buckets: BucketServer, daemon: DaemonFactory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor the cloud's metadata address, even if there are no credentials."""
    made = make_map(tmp_path / "files", columns=2, rows=2, points=300)
    publish(made.root, buckets.url("examined"))
    shim, seen = built_preload("connects", tmp_path), tmp_path / "connects"
    file = tmp_path / "shmmap.toml"
    file.write_text(f'map_path = "{buckets.url("examined")}"\n')
    one = daemon("", start=False)
    monkeypatch.setenv("LD_PRELOAD", str(shim))
    monkeypatch.setenv("CONNECTS_SEEN", str(seen))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert doctor(one, "--config", str(file))[1]["link"]["state"] == "ok"
    for name in KEYS:
        monkeypatch.delenv(name)
    found = doctor(one, "--config", str(file))[1]
    assert found["credentials"]["fact"].startswith("from nowhere: requests are not signed")
    assert set(seen.read_text().split()) == {"127.0.0.1"}


@pytest.mark.root
def test_another_account_learns_what_it_cannot_see(
    bucket: DaemonProcess, web: FaultyWeb, tmp_path: Path
) -> None:
    until_row(bucket, "versions", "is served")
    for path in (bucket.runtime_dir, bucket.shm_dir):
        os.chmod(path, 0o755)
        for name in os.listdir(path):
            os.chmod(f"{path}/{name}", 0o644)
    program = (
        "import os, sys\n"
        "from shmmap.cli.entry import main\n"
        "import shmmap.cli.verbs.look.monitors, shmmap.doctor.checks, shmmap.client.client\n"
        "import shmmap.client.discovery\n"
        "import shmmap.client.event_stream, shmmap.daemon.config, msgspec, shmmap.service.program\n"
        f"os.setgroups([]); os.setgid({OTHER_USER}); os.setuid({OTHER_USER})\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    words = ["--instance", bucket.instance, "--runtime-dir", bucket.runtime_dir, "--shm-dir", bucket.shm_dir]
    done = subprocess.run(
        [sys.executable, "-c", program, "doctor", "--json", *words],
        cwd="/",
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), "HOME": "/nonexistent"},
        capture_output=True,
        text=True,
    )
    assert done.stdout, done.stderr
    found = {one["name"]: one for one in json.loads(done.stdout)["findings"]}
    said = found["credentials"]["fact"] + found["link"]["fact"]
    assert "can be seen with sudo" in said or "it cannot be asked" in said
    assert found["versions"]["fact"].startswith("version 1")
    assert KEYS["AWS_SECRET_ACCESS_KEY"] not in done.stdout
