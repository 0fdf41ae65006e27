# SPDX-License-Identifier: Apache-2.0
"""Wrong answers of stores: each ends at its limit, under its true name, and no other host is asked."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from shmmap.errors import ConfigError, Offline, ShmmapError
from shmmap.processes.request_threads import PREFIX
from tests.support.daemon_process import Deadline
from tests.support.web_servers import WRONG_ANSWERS, FaultyWeb, endless_error, faulty_web

pytest.importorskip("obstore", reason="obstore is not installed")
pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.map_versions import refuse_if_signed
from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import Store, StoreRefused, Timeouts
from shmmap.origin.remote.transport import reporting_bytes

ONCE = Timeouts(connect_s=30.0, read_s=30.0, retries=0, retry_s=0.0)
SOON = Timeouts(connect_s=5.0, read_s=0.5, retries=0, retry_s=0.0)
"""For answers that never end; where one that does is read, a busy machine may take longer."""
AGAIN = Timeouts(connect_s=5.0, read_s=5.0, retries=4, retry_s=60.0)
TEXT = b'{"version": 1, "root": "ab", "bytes": 12}'
SECRET = "of-the-session"


@pytest.fixture
def other() -> Iterator[FaultyWeb]:
    """Another server, which must not be asked for anything."""
    with faulty_web(lambda _path: TEXT) as server:
        yield server


@pytest.fixture
def web(monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyWeb]:
    """A server whose answers are wrong in the way that the last part of the path names."""
    for name, value in {
        "AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_SESSION_TOKEN": SECRET,
        "AWS_REGION": "us-east-1",
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    with faulty_web(lambda _path: TEXT) as server:
        monkeypatch.setenv("AWS_ENDPOINT_URL", server.url)
        server.fault = lambda path: path.rpartition("/")[2].replace("%20", " ")
        yield server


def opened(web: FaultyWeb, scheme: str, timeouts: Timeouts = ONCE) -> Store:
    return open_store("s3://maps/m" if scheme == "s3" else f"{web.url}/m", timeouts=timeouts)


def outcome(ask: Callable[[], object]) -> str:
    try:
        return repr(ask())
    except ShmmapError as error:
        return f"{type(error).__name__}: {error.message}"


SLOW = "the answer was not complete within"
CUT = "the answer ended after 20"
PAGE = "what the store answers is no map: a page"
NO_LENGTH = "its answer has no length"
READ = repr(TEXT)
READ_OF = {
    "drip head": (SLOW, "no answer in time"), "continue": (SLOW, "no answer in time"),
    "drip body": (SLOW, SLOW), "drip error": ("refused (status 503)", SLOW),
    "drip chunks": (SLOW, NO_LENGTH), "endless": ("or more, at most 99 are read", NO_LENGTH),
    "chunked": (READ, NO_LENGTH), "chunked cut": (CUT, NO_LENGTH), "no length": (READ, NO_LENGTH),
    "cut": (f"{CUT} of 41 bytes", f"{CUT} of 41 bytes"),
    "gzip": ("compressed ('gzip')", "compressed ('gzip')"),
    "page": (f"{PAGE} (text/html)", f"{PAGE} (text/html)"),
    "page of no type": (f"{PAGE} (of no stated type)", f"{PAGE} (of no stated type)"),
    "not modified": ("status 304: not modified", "status 304: not modified"),
    "partial": ("refused (status 206)", repr(TEXT[:5])), "no HTTP": ("is no HTTP", "is no HTTP"),
    "closed": ("no answer", "no answer"),
}  # fmt: skip
"""What is said when an object is read from a web server, and from a bucket."""
ENDLESS = {"drip head", "continue", "drip body", "drip error", "drip chunks"}


@pytest.mark.parametrize("scheme", ["http", "s3"])
def test_each_wrong_answer_ends_under_its_name(web: FaultyWeb, scheme: str) -> None:
    assert READ_OF.keys() == WRONG_ANSWERS.keys()
    soon, once = opened(web, scheme, SOON), opened(web, scheme)
    with ThreadPoolExecutor(len(READ_OF)) as threads:
        found = threads.map(
            lambda fault: outcome(lambda: bytes((soon if fault in ENDLESS else once).get(fault, 99))), READ_OF
        )
        for fault, says in zip(READ_OF, found, strict=True):
            assert READ_OF[fault][scheme == "s3"] in says, (fault, says)
            assert "internal" not in says.lower()
            assert SECRET not in says
    waiting = Deadline()
    while waiting(any(one.name.startswith(PREFIX) for one in threading.enumerate())):
        pass  # what was given up ends, too


@pytest.mark.parametrize("scheme", ["http", "s3"])
def test_a_page_is_no_object_of_any_size(web: FaultyWeb, scheme: str) -> None:
    store = opened(web, scheme)
    for fault in ("page", "page of no type"):
        assert PAGE in outcome(partial(store.get_exactly, fault, 4000))
        assert PAGE in outcome(partial(store.get_exactly, fault, 7))
    assert PAGE in outcome(lambda: store.head("page"))
    web.fault = lambda _path: "page of no type"
    assert PAGE in outcome(lambda: refuse_if_signed(store, ""))


def test_a_bucket_s_other_answers_have_their_names(web: FaultyWeb) -> None:
    store = opened(web, "s3")
    web.fault = lambda _path: fault
    for fault, says in (("page", PAGE), ("gzip", "no listing"), ("chunked cut", "its listing ended early")):
        assert says in outcome(lambda: list(store.list("versions/"))), fault
    for fault, says in (("page", "no ETag"), ("continue", "no answer in time"), ("drip error", SLOW)):
        one = opened(web, "s3", SOON if fault in ENDLESS else ONCE)
        assert says in outcome(partial(one.put, "blobs/sha256/aa", b"1")), fault
    for fault, hint in (
        ("503", "try again later"),
        ("404", "is the address that of a store"),
        ("400", "clock"),
    ):
        with pytest.raises(StoreRefused, match=f"status {fault}") as refused:
            list(store.list("versions/"))
        assert hint in refused.value.hint


ODD_ANSWERS = {
    b"300 Several\r\nLocation: http://localhost/": "refused (status 300)",
    b"101 Other\r\nUpgrade: h2c\r\nConnection: upgrade": "refused (status 101)",
    b"600 Odd": "refused (status 600)",
    b"200 OK\r\nLast-Modified: now": "a header that cannot be read",
    b"200 OK\r\nETag: \xff": "a header that cannot be read",
    b"200 OK\r\nContent-Type: \xff": "a header that cannot be read",
    b"403 Forbidden": "refused, with an error that is no UTF-8",
}


def test_an_error_that_drips_ends_as_soon_for_a_large_object(web: FaultyWeb) -> None:
    assert f"{SLOW} 2 s" in outcome(partial(opened(web, "s3", SOON).get, "drip error", 1 << 30))


@pytest.mark.parametrize("ask", ["get", "put", "list"])
def test_an_error_without_end_is_not_read_into_memory(
    web: FaultyWeb, monkeypatch: pytest.MonkeyPatch, ask: str
) -> None:
    asks: dict[str, Callable[[Store], object]] = {
        "get": lambda store: store.get("CURRENT", 99),
        "put": lambda store: store.put("blobs/sha256/aa", b"1"),
        "list": lambda store: list(store.list("versions/")),
    }
    sent: list[int] = []

    def pieces(data: bytes) -> Iterator[bytes]:
        for piece in endless_error(data):
            sent.append(len(piece))
            yield piece

    monkeypatch.setitem(WRONG_ANSWERS, "endless error", pieces)
    web.fault = lambda _path: "endless error"
    assert "its answer, which is no object, has more than 64 MiB" in outcome(
        lambda: asks[ask](opened(web, "s3", AGAIN))
    )
    assert sum(sent) > 64 << 20
    assert "no permission" in outcome(lambda: opened(web, "http").get("CURRENT", 99))
    web.fault = lambda _path: ""
    assert bytes(opened(web, "s3", AGAIN).get("CURRENT", 99)) == TEXT


def _only(answer: bytes, _data: bytes) -> list[bytes]:
    return [answer]


def test_what_a_bucket_answers_is_no_silence(web: FaultyWeb, monkeypatch: pytest.MonkeyPatch) -> None:
    store = opened(web, "s3")
    for number, (odd, says) in enumerate(ODD_ANSWERS.items()):
        body = b"\xff" if says.endswith("UTF-8") else b"x"
        answer = b"HTTP/1.1 %s\r\nConnection: close\r\nContent-Length: 1\r\n\r\n%s" % (odd, body)
        monkeypatch.setitem(WRONG_ANSWERS, f"odd {number}", partial(_only, answer))
        assert says in outcome(partial(store.get, f"odd {number}", 99)), odd


def test_an_upload_may_take_longer_than_silence(web: FaultyWeb) -> None:
    store = opened(web, "s3", SOON)

    def take_in_slowly(_path: str) -> str:
        time.sleep(2 * SOON.read_s)
        return ""

    web.fault = take_in_slowly
    store.put("blobs/sha256/aa", bytes(3 << 20))


NAMES = b"".join(
    b"<Contents><Key>m/v/%d</Key><LastModified>2026-01-01T00:00:00.000Z</LastModified><Size>5</Size></Contents>"
    % at
    for at in range(990)  # of a thousand that are read at a time each begins with another one, for 99 times
)
NEXT = b"<NextContinuationToken>more</NextContinuationToken>"


def test_a_listing_that_repeats_is_no_listing(web: FaultyWeb) -> None:
    store = opened(web, "s3")
    web.fault = lambda _path: ""
    web.read = lambda _path: b"<ListBucketResult>%s%s</ListBucketResult>" % (NAMES, NEXT)
    assert "its listing repeats without end" in outcome(lambda: sum(1 for _ in store.list("v/")))
    web.read = lambda _path: b"<ListBucketResult>%s</ListBucketResult>" % NAMES
    assert sum(1 for _ in store.list("v/")) == 990


@pytest.mark.parametrize(
    ("scheme", "to"),  # of a bucket, redirects to another port of the same host cannot be refused
    [("http", "http://127.0.0.1"), *((scheme, to) for scheme in ("http", "s3") for to in
     ("http://localhost", "https://localhost"))],
)  # fmt: skip
def test_redirects_to_other_servers_are_refused(
    web: FaultyWeb, other: FaultyWeb, scheme: str, to: str
) -> None:
    port = other.url.rpartition(":")[2]
    web.fault = lambda _path: f"redirect {to}:{port}"
    store = opened(web, scheme)
    asks: list[Callable[[], object]] = [lambda: store.get("CURRENT", 99), lambda: store.head("CURRENT")]
    if scheme == "s3":
        asks += [lambda: store.put("CURRENT", b"1"), lambda: list(store.list("versions/"))]
    for ask in asks:
        assert "refused, it is somewhere else" in outcome(ask)
    assert other.requests() == []
    assert not other.connections


@pytest.mark.parametrize("ask", ["get", "head", "list"])
def test_credentials_stay_at_the_port_of_the_store(web: FaultyWeb, other: FaultyWeb, ask: str) -> None:
    """Redirects of a bucket to another port of its host are followed: obstore cannot refuse them."""
    asks: dict[str, Callable[[Store], object]] = {
        "get": lambda store: bytes(store.get("CURRENT", 99)),
        "head": lambda store: store.head("CURRENT"),
        "list": lambda store: list(store.list("versions/")),
    }
    web.fault = lambda _path: f"redirect {other.url}"
    outcome(lambda: asks[ask](opened(web, "s3")))
    assert "authorization" in web.last_headers
    assert other.requests()
    assert "authorization" not in other.last_headers
    assert "refused, it is somewhere else" in outcome(lambda: opened(web, "s3").put("CURRENT", b"1"))
    assert len(other.requests()) == 0


def test_redirects_within_a_web_server_are_followed_to_their_end(web: FaultyWeb) -> None:
    web.fault = lambda path: f"redirect {web.url}/new" if not path.startswith("new/") else ""
    assert bytes(opened(web, "http").get("CURRENT", 99)) == TEXT
    assert web.requests() == [("m/CURRENT", 302), ("new/m/CURRENT", 200)]
    web.fault = lambda _path: f"redirect {web.url}"
    assert "its redirects do not end" in outcome(lambda: opened(web, "http").get("CURRENT", 99))

    def redirect_slowly(_path: str) -> str:
        time.sleep(0.5)
        return f"redirect {web.url}"

    web.fault = redirect_slowly
    store = opened(web, "http", Timeouts(connect_s=5.0, read_s=1.0, retries=0, retry_s=0.0))
    assert f"{SLOW} 2 s" in outcome(lambda: store.get("CURRENT", 99))


def test_a_body_that_was_cut_is_gone_on_with(web: FaultyWeb) -> None:
    web.fault = lambda _path: "stall body"
    store = opened(web, "http", Timeouts(connect_s=5.0, read_s=0.3, retries=4, retry_s=60.0))
    assert bytes(store.get("CURRENT", 99)) == TEXT
    assert [status for _, status in web.requests()] == [200, 206]


def test_parts_of_two_states_are_not_joined(web: FaultyWeb, monkeypatch: pytest.MonkeyPatch) -> None:
    """The object is replaced between the two requests, and the server does not look at ``If-Range``."""
    states, faults = iter([TEXT]), iter(["truncate"])
    web.read = lambda _path: next(states, TEXT.replace(b"ab", b"cd"))
    web.fault = lambda _path: next(faults, "")
    assert bytes(opened(web, "http", AGAIN).get("CURRENT", 99)) == TEXT.replace(b"ab", b"cd")
    head = b"HTTP/1.1 206 Partial Content\r\nConnection: close\r\nContent-Range: bytes 20-40/41\r\n"
    for more, says in (
        (b"Content-Length: 50\r\n\r\n" + bytes(50), "sent more than the 41 bytes announced"),
        (b"Content-Length: 21\r\nContent-Encoding: gzip\r\n\r\n" + bytes(21), "is another part than"),
    ):
        monkeypatch.setitem(WRONG_ANSWERS, "other part", partial(_only, head + more))
        faults, states = iter(["truncate", "other part"]), iter([TEXT, TEXT])
        assert says in outcome(partial(opened(web, "http", AGAIN).get, "CURRENT", 99))


def test_redirects_to_names_that_are_not_escaped(web: FaultyWeb, monkeypatch: pytest.MonkeyPatch) -> None:
    moved = "HTTP/1.1 302 Found\r\nLocation: /new/\u00e4 b\r\nContent-Length: 0\r\n\r\n".encode()
    monkeypatch.setitem(WRONG_ANSWERS, "moved", partial(_only, moved))
    web.fault = lambda path: "" if path.startswith("new/") else "moved"
    assert bytes(opened(web, "http").get("CURRENT", 99)) == TEXT
    assert web.requests()[-1] == ("new/%C3%A4%20b", 200)


@pytest.mark.parametrize("scheme", ["http", "s3"])
def test_hints_fit_the_status(web: FaultyWeb, scheme: str) -> None:
    web.fault = lambda _path: status
    for status, hint in {
        "429": "try again later", "408": "try again later", "507": "try again later", "405": "address",
        "451": "address", "414": "address", "407": "name the proxy", "400": "credentials",
        "511": "login page",
    }.items():  # fmt: skip
        with pytest.raises(StoreRefused, match=f"status {status}") as refused:
            opened(web, scheme).get("CURRENT", 99)
        assert hint in refused.value.hint
    status = "403"
    with pytest.raises(StoreRefused, match="no permission") as refused:
        opened(web, scheme).get("CURRENT", 99)
    assert ("without credentials" in refused.value.hint) == (scheme == "http")


@pytest.mark.parametrize("url", ["https://maps.example.org/m", "s3://maps/m"])
def test_a_proxy_that_does_not_connect_is_no_silence(
    other: FaultyWeb, monkeypatch: pytest.MonkeyPatch, url: str
) -> None:
    monkeypatch.setenv("https_proxy", other.url)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "https://store.example.org")
    assert "the proxy does not connect to it" in outcome(partial(open_store(url, timeouts=ONCE).get, "m", 99))


@pytest.mark.parametrize("scheme", ["http", "s3"])
def test_plain_http_at_the_other_end_is_no_silence(
    web: FaultyWeb, monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    web.fault = lambda _path: "no HTTP"
    tls = web.url.replace("http://", "https://")
    monkeypatch.setenv("AWS_ENDPOINT_URL", tls)
    store = open_store("s3://maps/m" if scheme == "s3" else f"{tls}/m", timeouts=ONCE)
    assert "the answer is no TLS" in outcome(partial(store.get, "CURRENT", 99))


@pytest.mark.parametrize("endpoint", ["127.0.0.1:9000", "https://", "http://[bad", "ftp://host"])
def test_an_address_that_is_no_url_is_refused(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    with pytest.raises(ConfigError, match="AWS_ENDPOINT_URL is no URL of a server"):
        open_store("s3://maps/m")


def test_an_idle_connection_that_was_closed_is_no_failure(web: FaultyWeb) -> None:
    store = opened(web, "http")
    assert bytes(store.get("m", 99)) == TEXT
    web.refuse()
    web.listen()
    assert bytes(store.get("m", 99)) == TEXT


@pytest.mark.parametrize("scheme", ["http", "s3"])
def test_what_fails_for_a_moment_is_asked_again(web: FaultyWeb, scheme: str) -> None:
    failing = iter(["503", "500", "closed"])
    web.fault = lambda _path: next(failing, "")
    assert bytes(opened(web, scheme, AGAIN).get("CURRENT", 99)) == TEXT


def test_a_proxy_of_the_environment_is_used(
    web: FaultyWeb, other: FaultyWeb, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("http_proxy", other.url.replace("http://", "http://user:pass%40word@"))
    assert bytes(opened(web, "http").get("CURRENT", 99)) == TEXT
    assert other.requests() == [(f"{web.url}/m/CURRENT", 200)]
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    assert bytes(opened(web, "http").get("CURRENT", 99)) == TEXT
    assert web.requests() == [("m/CURRENT", 200)]
    monkeypatch.delenv("no_proxy")
    for bad in ("socks5://127.0.0.1:1/", "http://127.0.0.1:", "http://["):
        monkeypatch.setenv("http_proxy", f"{bad}{SECRET}")
        with pytest.raises(ConfigError, match="proxy that the environment names") as refused:
            opened(web, "http")
        assert SECRET not in str(refused.value)


# --- credentials that change while a program runs -----------------------------------------------------


def test_credentials_spoilt_while_they_are_used_are_named(
    web: FaultyWeb, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "credentials"
    lines = "[default]\naws_access_key_id = key\naws_secret_access_key = secret\n"
    file.write_text(lines)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(file))
    store = opened(web, "s3")
    file.write_text(f"{lines}aws_session_token = {SECRET}\n  second line\n")
    with pytest.raises(Offline, match="aws_session_token has a line break after") as refused:
        store.get("CURRENT", 99)
    assert SECRET not in str(refused.value)
    file.write_text(lines)
    assert bytes(store.get("m", 99)) == TEXT


def test_a_panic_is_the_failure_of_its_request(web: FaultyWeb) -> None:
    """Values that nothing has checked make obstore panic, which is no `Exception`."""
    from obstore.store import S3Store

    store = opened(web, "s3", AGAIN)
    bad = {"access_key_id": "key\nspoilt", "secret_access_key": "b", "endpoint": web.url, "region": "r"}
    opened_bad = S3Store("maps", config=bad, client_options={"allow_http": True})  # type: ignore[arg-type]
    vars(store)["_store"] = lambda _nbytes=0, **_: opened_bad
    found: list[str] = []
    thread = threading.Thread(target=lambda: found.append(outcome(lambda: store.get("CURRENT", 99))))
    thread.start()
    thread.join()
    assert "the request has made the package obstore fail" in found[0]
    assert "the request has made the package obstore fail" in outcome(lambda: store.get("CURRENT", 99))


@pytest.mark.parametrize("scheme", ["s3", "http"])
def test_bytes_are_reported_as_they_come_and_to_whom_asked_for_them(web: FaultyWeb, scheme: str) -> None:
    web.heal()
    store, mine, others = opened(web, scheme), list[int](), list[int]()
    with reporting_bytes(others.append), ThreadPoolExecutor(1) as pool:
        pool.submit(store.get, "CURRENT", 1000).result()  # in a thread that reports nothing
        with reporting_bytes(mine.append):
            assert bytes(store.get("CURRENT", 1000)) == TEXT
    assert (sum(mine), others) == (len(TEXT), [])
    store.get("CURRENT", 1000)
    assert sum(mine) == len(TEXT)
