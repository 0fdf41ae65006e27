# SPDX-License-Identifier: Apache-2.0
"""Stores: the same conditions in each, errors that hold no secret, no address but the given one."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from shmmap.errors import BadRequest, CannotWrite, ConfigError, MapDataError, MapMissing, Offline
from tests.support.map_stores import BucketServer
from tests.support.skips import programs_or_skip

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import Store, Timeouts, read_url

SOON = Timeouts(connect_s=0.5, read_s=0.3, retries=0, retry_s=0.5)
ONCE = Timeouts(connect_s=30.0, read_s=30.0, retries=0, retry_s=30.0)
"""For servers that answer, however busy the machine is."""
AGAIN = Timeouts(connect_s=30.0, read_s=30.0, retries=8, retry_s=30.0)
"""Of concurrent writers, Ceph's gateway answers the losers with status 500, and with 412 on a second try."""


@pytest.fixture(params=["directory", "file", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    if request.param == "s3":
        server: BucketServer = request.getfixturevalue("buckets")
        return open_store(server.url(re.sub(r"\W", "-", request.node.name)), timeouts=AGAIN)
    path = tmp_path / "map"
    return open_store(f"file://{path}" if request.param == "file" else str(path))


def test_objects_are_whole_or_not_there(store: Store) -> None:
    with pytest.raises(MapMissing, match="CURRENT is not there"):
        store.get("CURRENT", 100)
    assert store.head("blobs/sha256/ab") is None
    assert list(store.list("blobs/")) == []
    store.put("blobs/sha256/ab", b"12345")
    store.put("blobs/sha256/ab", b"12345")
    assert bytes(store.get("blobs/sha256/ab", 5)) == b"12345"
    assert bytes(store.get_exactly("blobs/sha256/ab", 5)) == b"12345"
    found = store.head("blobs/sha256/ab")
    assert found is not None
    assert (found.path, found.size) == ("blobs/sha256/ab", 5)
    assert abs(found.modified_s - time.time()) < 60
    assert [one.path for one in store.list("blobs/")] == ["blobs/sha256/ab"]
    store.delete("blobs/sha256/ab")
    store.delete("blobs/sha256/ab")
    assert list(store.list("blobs/")) == []


def test_no_more_is_read_than_was_asked_for(store: Store) -> None:
    store.put("blobs/sha256/cd", b"12345")
    with pytest.raises(MapDataError, match="it has 5 bytes, at most 4"):
        store.get("blobs/sha256/cd", 4)
    with pytest.raises(MapDataError, match="it has 5 bytes, not 4"):
        store.get_exactly("blobs/sha256/cd", 4)
    with pytest.raises(MapDataError, match="it has 5 bytes, not 6"):
        store.get_exactly("blobs/sha256/cd", 6)


def test_what_is_new_replaces_nothing(store: Store) -> None:
    assert store.put_new("versions/1.json", b"one")
    assert not store.put_new("versions/1.json", b"other")
    assert bytes(store.get("versions/1.json", 99)) == b"one"


def test_a_state_is_replaced_once(store: Store) -> None:
    store.put_new("CURRENT", b"one")
    data, tag = store.get_tagged("CURRENT", 99)
    assert bytes(data) == b"one"
    assert store.put_if("CURRENT", b"two", tag)
    assert not store.put_if("CURRENT", b"three", tag)
    assert bytes(store.get("CURRENT", 99)) == b"two"
    _, tag = store.get_tagged("CURRENT", 99)
    store.delete("CURRENT")
    assert not store.put_if("CURRENT", b"four", tag)
    assert store.head("CURRENT") is None


def test_of_many_at_once_one_wins(store: Store) -> None:
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda i: store.put_new("versions/2.json", b"%d" % i), range(8)))
        assert made.count(True) == 1
        assert bytes(store.get("versions/2.json", 9)) == b"%d" % made.index(True)
        store.put_new("CURRENT", b"begin")
        _, tag = store.get_tagged("CURRENT", 9)
        switched = list(pool.map(lambda i: store.put_if("CURRENT", b"%d" % i, tag), range(8)))
        assert switched.count(True) == 1
        assert bytes(store.get("CURRENT", 9)) == b"%d" % switched.index(True)


def test_a_web_server_reads_a_directory(web: tuple[str, Path]) -> None:
    url, folder = web
    open_store(str(folder / "town")).put("blobs/sha256/ef", b"123")
    store = open_store(f"{url}/town", timeouts=ONCE)
    assert bytes(store.get_exactly("blobs/sha256/ef", 3)) == b"123"
    assert store.head("blobs/sha256/ef") is not None
    assert store.head("blobs/sha256/aa") is None
    with pytest.raises(MapMissing):
        store.get("CURRENT", 99)
    for write in (lambda: store.put_new("CURRENT", b""), lambda: list(store.list("versions/"))):
        with pytest.raises(BadRequest, match="a web server cannot be written to"):
            write()


def test_objects_in_buckets_say_how_long_they_may_be_kept(buckets: BucketServer) -> None:
    import obstore
    from obstore.store import S3Store

    store = open_store(buckets.url("kept"))
    store.put("blobs/sha256/aa", b"1")
    store.put_new("CURRENT", b"2")
    plain = S3Store.from_url(buckets.url("kept"), client_options={"allow_http": True})
    found = {
        path: obstore.get(plain, path).attributes["Cache-Control"] for path in ("blobs/sha256/aa", "CURRENT")
    }
    assert found == {"blobs/sha256/aa": "public, max-age=31536000, immutable", "CURRENT": "no-cache"}


# --- directories --------------------------------------------------------------------------------------


def test_a_directory_that_cannot_be_written_is_an_error_with_a_hint(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(CannotWrite):
        open_store(str(tmp_path / "file" / "map")).put("blobs/sha256/aa", b"")


def test_what_is_no_file_never_blocks(tmp_path: Path) -> None:
    store = open_store(str(tmp_path))
    os.mkfifo(tmp_path / "CURRENT")
    assert bytes(store.get("CURRENT", 9)) == b""
    (tmp_path / "versions").mkdir()
    with pytest.raises(MapDataError, match="it is a directory"):
        store.get("versions", 9)


# --- URLs ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("s3://maps/town/", "s3://maps/town"), ("gs://Maps", "gs://Maps"), ("az://c/a/b", "az://c/a/b"),
        ("https://example.com:8443/m/", "https://example.com:8443/m"), ("file:///a/b/", "/a/b"),
        ("file://localhost/a", "/a"), ("/a/../b", "/b"), ("HTTP://[::1]:80/x", "http://[::1]:80/x"),
    ],
)  # fmt: skip
def test_urls(given: str, text: str) -> None:
    assert read_url(given).text == text


SECRET = "hunter2"


@pytest.mark.parametrize(
    "url",
    [
        f"https://user:{SECRET}@example.com/m", f"https://{SECRET}@example.com/m", f"s3://k:{SECRET}@b/m",
        f"https://example.com/m?token={SECRET}", f"s3://b/m#{SECRET}", f"http://example.com/?{SECRET}",
        f"ftp://user:{SECRET}@example.com/m", f"https://[{SECRET}/m", f"https://h:{SECRET}/m",
    ],
)  # fmt: skip
def test_urls_that_may_hold_a_secret_are_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(BadRequest) as error:
        read_url(url)
    assert SECRET not in str(error.value)


@pytest.mark.parametrize(
    "url", ["", "s3://", "https:///m", "file://elsewhere/m", "s3://b/../c", "s3://b/a b"]
)
def test_what_is_no_url_of_a_map(url: str) -> None:
    with pytest.raises(BadRequest):
        read_url(url)


@pytest.mark.parametrize("host", ["example.com", "192.168.1.9", "169.254.169.254"])
def test_plain_http_beyond_this_machine_has_to_be_wanted(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("obstore", reason="obstore is not installed")
    with pytest.raises(BadRequest, match="can be read and changed") as caught:
        open_store(f"http://{host}/m")
    assert "--trust ROOT.json where the map is signed" in caught.value.hint
    open_store(f"http://{host}/m", insecure_http=True)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:9000")
    with pytest.raises(BadRequest, match="can be read and changed"):
        open_store("s3://b/m")


# --- errors -------------------------------------------------------------------------------------------


class Answering:
    """A server that gives every request the same answer; None: none at all."""

    def __init__(self, answer: bytes | None) -> None:
        self.answers = answer is not None
        self._answer = answer
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._open: list[socket.socket] = []
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                one, _ = self._listener.accept()
            except OSError:
                return
            self._open.append(one)
            if self._answer is not None:
                one.recv(65536)
                one.sendall(self._answer)
                one.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()
        for one in self._open:
            one.close()


@pytest.fixture
def answering(request: pytest.FixtureRequest) -> Iterator[Answering]:
    pytest.importorskip("obstore", reason="obstore is not installed")
    server = Answering(request.param)
    yield server
    server.close()


def answer(status: str, body: str = "") -> bytes:
    return f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n{body}".encode()


@pytest.mark.parametrize(
    ("answering", "kind", "says"),
    [
        (None, Offline, "no answer"),
        (answer("404 Not Found"), MapMissing, "is not there"),
        (answer("403 Forbidden", f"<Key>{SECRET}</Key>"), Offline, "refused, no permission"),
        (answer("401 Unauthorized"), Offline, "refused, no permission"),
        (answer("400 Bad Request", f"ExpiredToken {SECRET}"), Offline, "refused (status 400)"),
        (answer("503 Slow Down", SECRET), Offline, "refused (status 503)"),
        (answer("301 Moved Permanently", SECRET), Offline, "refused, it is somewhere else"),
        (
            b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\nConnection: close\r\n\r\n123",
            Offline,
            "ended after 3 of 9 bytes",
        ),
        (b"what is this\r\n\r\n", Offline, "the answer is no HTTP"),
        (answer("200 OK", "x" * 100), MapDataError, "it has 100 bytes, at most 99"),
    ],
    indirect=["answering"],
)
@pytest.mark.parametrize("scheme", ["s3", "http"])
def test_answers_become_errors_without_secrets(
    answering: Answering, kind: type[Exception], says: str, scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", SECRET)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{answering.port}")
    url = "s3://maps/m" if scheme == "s3" else f"http://127.0.0.1:{answering.port}/m"
    with pytest.raises(kind) as error:
        open_store(url, timeouts=ONCE if answering.answers else SOON).get("CURRENT", 99)
    assert says in str(error.value)
    assert f"{url}/CURRENT" in str(error.value)
    import traceback

    assert SECRET not in "".join(traceback.format_exception(error.value))


def test_a_certificate_that_no_authority_vouches_for(tmp_path: Path) -> None:
    pytest.importorskip("obstore", reason="obstore is not installed")
    programs_or_skip("openssl")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
         "-keyout", str(key), "-out", str(certificate), "-days", "1", "-subj", "/CN=localhost"],
        check=True, capture_output=True,
    )  # fmt: skip
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    listener = socket.create_server(("127.0.0.1", 0))

    def shake_hands() -> None:
        one, _ = listener.accept()
        with one, contextlib.suppress(ssl.SSLError, OSError):
            context.wrap_socket(one, server_side=True).close()

    thread = threading.Thread(target=shake_hands)
    thread.start()
    try:
        url = f"https://127.0.0.1:{listener.getsockname()[1]}/m"
        with pytest.raises(Offline, match="certificate is not accepted") as error:
            open_store(url, timeouts=ONCE).get("CURRENT", 9)
    finally:
        thread.join()
        listener.close()
    assert "SSL_CERT_FILE" in error.value.hint


GUARDED = """
import json, socket, sys
from shmmap.errors import ShmmapError
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import Timeouts
soon = Timeouts(connect_s=0.3, read_s=0.3, retries=0, retry_s=0.3)
for url in sys.argv[1:]:
    store = open_store(url, timeouts=soon)
    try:
        store.get("CURRENT", 99)
    except ShmmapError as error:
        print(type(error).__name__, error.message)
"""


def test_no_address_but_the_given_one_is_asked(tmp_path: Path) -> None:
    """Without credentials in sight: what the kernel saw of connections is written down by strace."""
    pytest.importorskip("obstore", reason="obstore is not installed")
    programs_or_skip("strace")
    listener = socket.create_server(("127.0.0.1", 0))
    listener.listen()
    endpoint = f"http://127.0.0.1:{listener.getsockname()[1]}"
    environment = {
        "PATH": os.environ["PATH"], "HOME": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path),
        "AWS_ENDPOINT_URL": endpoint, "AZURE_STORAGE_ACCOUNT_NAME": "a", "AZURE_ENDPOINT": endpoint,
    }  # fmt: skip
    trace = tmp_path / "trace"
    done = subprocess.run(
        ["strace", "-f", "-qq", "-e", "trace=connect,sendto,sendmsg", "-o", str(trace), sys.executable, "-c",
         GUARDED, "s3://maps/m", "az://maps/m", f"{endpoint}/m"],
        env=environment, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    listener.close()
    if "ptrace" in done.stderr.lower():
        pytest.skip("strace may not trace here")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("no answer") == 3, done.stdout + done.stderr
    asked = set(re.findall(r"sin6?_(?:addr|port).*", trace.read_text()))
    addresses = set(re.findall(r'inet_addr\("([^"]+)"\)|inet_pton\(AF_INET6, "([^"]+)"', "".join(asked)))
    assert addresses == {("127.0.0.1", "")}


# --- credentials --------------------------------------------------------------------------------------


def test_settings_that_cannot_be_used_are_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("obstore", reason="obstore is not installed")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", SECRET)
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY", raising=False)
    with pytest.raises(ConfigError) as error:
        open_store("s3://b/m")
    assert SECRET not in str(error.value)
