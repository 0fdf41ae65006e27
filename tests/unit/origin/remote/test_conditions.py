# SPDX-License-Identifier: Apache-2.0
"""What a store can do is asked before anything is sent: five requests distinguish what stores fail to do."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from shmmap.errors import BadRequest, CannotWrite, Offline, ShmmapError
from tests.support.map_stores import BucketServer
from tests.support.store_proxy import (
    IGNORING,
    Answer,
    Asked,
    Forward,
    Rule,
    StoreProxy,
    conditional,
    honest,
    page,
    with_tags,
)

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.store import Store, StoreRefused, Timeouts

ONCE = Timeouts(connect_s=30.0, read_s=30.0, retries=0, retry_s=30.0)
AGAIN = Timeouts(connect_s=30.0, read_s=30.0, retries=8, retry_s=30.0)


class Proxy(StoreProxy):
    """A proxy, and a map behind it that no other test has."""

    map = ""

    def opened(self, *, sole: bool = False, timeouts: Timeouts = ONCE) -> Store:
        return open_store(f"s3://maps/{self.map}", timeouts=timeouts, sole_publisher=sole)

    @property
    def path(self) -> str:
        """Of the object that the store is asked with."""
        return f"/maps/{self.map}/conditions.json"


@pytest.fixture
def proxy(
    buckets: BucketServer, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Proxy]:
    with closing(Proxy(buckets.endpoint)) as proxy:
        proxy.map = f"asked-{re.sub(r'[^a-z0-9]', '-', request.node.name)}"
        monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.endpoint)
        yield proxy


def weak(tag: str) -> str:
    return f"W/{tag}"


def gone(_tag: str) -> str:
    return ""


def quick(tag: str) -> str:
    return tag[:-2] + '-x"'


def zipped(tag: str) -> str:
    """Name it as Apache does while it compresses."""
    return tag[:-1] + '-gzip"'


def swallowed(asked: Asked, forward: Forward) -> Answer:
    """Say that it was written."""
    return Answer(200, {"etag": f'"{hash(asked.body)}"'}) if asked.method == "PUT" else forward(asked)


def test_a_good_store_is_asked_five_times_once(proxy: Proxy) -> None:
    store = proxy.opened()
    for _ in range(3):
        store.require_conditions()
    assert proxy.requests() == [(method, proxy.path) for method in ("PUT", "GET", "PUT", "PUT", "PUT")]
    assert store.put_new("CURRENT", b"one")
    _, tag = store.get_tagged("CURRENT", 9)
    store.require_conditions(tag)
    assert store.put_if("CURRENT", b"two", tag)
    assert len(proxy.requests()) == 3


BAD: dict[str, tuple[Rule, type[ShmmapError], str]] = {
    "no If-None-Match": (IGNORING["If-None-Match"], CannotWrite, r"ignores .*\(If-None-Match\)"),
    "no If-Match": (IGNORING["If-Match"], CannotWrite, r"ignores .*\(If-Match\)"),
    "neither": (
        IGNORING["If-Match and If-None-Match"], CannotWrite, r"\(If-Match and If-None-Match\)",
    ),
    "weak": (with_tags(weak, "PUT", "GET", "HEAD"), CannotWrite, "gives weak ETags"),
    "weak and ignored": (
        lambda asked, forward: BAD["weak"][0](asked, lambda a: BAD["no If-Match"][0](a, forward)),
        CannotWrite, "gives weak ETags",
    ),
    "no ETag": (with_tags(gone, "PUT", "GET", "HEAD"), CannotWrite, "gives no ETags"),
    "no ETag of writes": (with_tags(gone, "PUT"), CannotWrite, "gives no ETags"),
    "other ETags of reads": (
        with_tags(zipped, "GET"), CannotWrite, "does not replace an object whose ETag",
    ),
    "weak ETags of reads": (with_tags(weak, "GET"), CannotWrite, "gives weak ETags"),
    "reads without tags": (with_tags(gone, "GET"), CannotWrite, "gives no ETags"),
    "other ETags": (with_tags(quick, "PUT", "GET"), CannotWrite, "does not replace an object whose ETag"),
    "501": (conditional(501), CannotWrite, r"takes no writes on conditions \(refused \(status 501\)\)"),
    "400": (
        conditional(400, b"<Error><Code>InvalidArgument</Code></Error>"), CannotWrite, r"\(status 400\)",
    ),
    "405": (conditional(405), CannotWrite, r"takes no writes on conditions .*\(status 405\)"),
    "404": (conditional(404), CannotWrite, "does not replace an object whose ETag|takes no writes on"),
    "signature": (
        conditional(403, b"<Error><Code>SignatureDoesNotMatch</Code></Error>"), CannotWrite,
        r"takes no writes on conditions \(refused, the secret does not belong to the access key\)",
    ),
    "412 to all": (conditional(412), CannotWrite, "does not replace an object whose ETag is named"),
    "a page": (page(), StoreRefused, r"what the store answers is no map: a page \(text/html\)"),
    "a page with an ETag": (page(etag='"1"'), StoreRefused, r"a page \(text/html\)"),
    "a page, no HTML": (page(etag='"1"', **{"content-type": "text/plain"}), StoreRefused, r"page \(text"),
    "writes get lost": (swallowed, StoreRefused, "has accepted it, and does not have it"),
    "403 to all": (lambda *_: Answer(403), StoreRefused, "no permission"),
    "503": (conditional(503), StoreRefused, r"status 503"),
}  # fmt: skip


@pytest.mark.parametrize("bad", BAD)
def test_what_fails_is_named_and_nothing_but_the_question_is_sent(proxy: Proxy, bad: str) -> None:
    proxy.rule, kind, says = BAD[bad]
    with pytest.raises(ShmmapError, match=says) as caught:
        proxy.opened().require_conditions()
    assert type(caught.value) is kind
    assert ("--sole-publisher" in caught.value.hint) == (kind is CannotWrite and "no ETag" not in bad)
    asked = proxy.requests()
    assert {path for _, path in asked} == {proxy.path}
    assert len(asked) <= (6 if "does not replace" not in says else 40)
    assert "DELETE" not in {method for method, _ in asked}


def test_etags_that_only_writes_have_weak_are_the_objects_own(proxy: Proxy) -> None:
    """A store whose replies to writes name another tag than an object gets is good."""
    for change in (quick, weak):
        proxy.rule = with_tags(change, "PUT")
        proxy.opened().require_conditions()


def test_a_tag_that_only_reading_weakens(proxy: Proxy) -> None:
    store = proxy.opened()
    store.put_new("CURRENT", b"one")
    store.require_conditions()
    proxy.rule = with_tags(weak, "GET", "HEAD")
    _, tag = store.get_tagged("CURRENT", 9)
    for ask in (lambda: store.require_conditions(tag), lambda: store.put_if("CURRENT", b"two", tag)):
        with pytest.raises(CannotWrite, match="gives weak ETags: a version cannot be replaced safely"):
            ask()
    proxy.rule = honest
    assert bytes(store.get("CURRENT", 9)) == b"one"


@pytest.mark.parametrize("rule", ["honest", "no If-None-Match", "no If-Match"])
def test_publishers_that_ask_at_the_same_time_do_not_misjudge_each_other(proxy: Proxy, rule: str) -> None:
    if rule != "honest":
        proxy.rule = BAD[rule][0]

    def ask(_: int) -> str:
        try:
            proxy.opened(timeouts=AGAIN).require_conditions()
        except CannotWrite as error:
            return error.message
        return ""

    with ThreadPoolExecutor(6) as pool:
        found = set(pool.map(ask, range(12)))
    if rule == "honest":
        assert found == {""}
    else:
        assert len(found) == 1
        assert f"({rule.removeprefix('no ')})" in found.pop()


def test_between_any_two_steps_of_one_comes_another(proxy: Proxy) -> None:
    """The worst case, for good and bad stores: before each request another publisher writes its question."""

    def between(rule: Rule) -> Rule:
        def both(asked: Asked, forward: Forward) -> Answer:
            headers = {name: value for name, value in asked.headers.items() if not name.startswith("if-")}
            question = b'{"asked": "%032x"}\n' % len(proxy.asked)
            assert forward(Asked("PUT", proxy.path, headers, question)).status == 200
            return rule(asked, forward)

        return both

    proxy.rule = between(honest)
    proxy.opened().require_conditions()
    assert len(proxy.requests()) == 5 * 5
    for name in ("no If-Match", "no If-None-Match", "neither", "501", "weak"):
        rule, kind, says = BAD[name]
        proxy.rule = between(rule)
        with pytest.raises(kind, match=says):
            proxy.opened().require_conditions()


def test_a_conflict_of_concurrent_writes_is_no_judgement(proxy: Proxy) -> None:
    """Stores refuse a right condition where another write is under way, even if that one fails."""
    conflicts = [409, 412, 409, 412]

    def rule(asked: Asked, forward: Forward) -> Answer:
        if "if-match" in asked.headers and conflicts:
            return Answer(conflicts.pop())
        return forward(asked)

    proxy.rule = rule
    proxy.opened().require_conditions()
    assert not conflicts
    for name in ("no If-Match", "no If-None-Match"):
        proxy.rule = BAD[name][0]
        with pytest.raises(CannotWrite, match="ignores the conditions"):
            proxy.opened().require_conditions()


def test_an_answer_that_gets_lost(proxy: Proxy) -> None:
    """The write is done, its answer is not: the repeated request is refused, and the object is as wanted."""
    lost: list[str] = []

    def rule(asked: Asked, forward: Forward) -> Answer:
        answer = forward(asked)
        if "if-match" in asked.headers and not lost:
            lost.append(asked.path)
            return Answer(503)
        return answer

    proxy.rule = rule
    proxy.opened(timeouts=AGAIN).require_conditions()
    assert lost


@pytest.mark.parametrize(
    "bad", ["no If-None-Match", "no If-Match", "neither", "weak", "weak and ignored", "other ETags", "501"]
)
def test_a_sole_publisher_needs_no_conditions(proxy: Proxy, bad: str) -> None:
    proxy.rule = BAD[bad][0]
    store = proxy.opened(sole=True)
    store.require_conditions()
    assert [method for method, _ in proxy.requests()] == ["PUT", "GET"]
    assert store.put_new("versions/1.json", b"one")
    assert store.put_new("versions/1.json", b"one")
    assert not store.put_new("versions/1.json", b"another")
    _, tag = store.get_tagged("versions/1.json", 99)
    store.require_conditions(tag)
    assert store.put_if("versions/1.json", b"two", tag)
    assert not store.put_if("versions/1.json", b"three", tag)
    assert bytes(store.get("versions/1.json", 99)) == b"two"


@pytest.mark.parametrize("rule", [page(), page(etag='"1"'), swallowed])
def test_a_sole_publisher_notices_what_is_no_store(proxy: Proxy, rule: Rule) -> None:
    proxy.rule = rule
    with pytest.raises(StoreRefused):
        proxy.opened(sole=True).require_conditions()


def test_other_stores_are_not_asked(tmp_path: Path, web: tuple[str, Path]) -> None:
    store = open_store(str(tmp_path / "map"), sole_publisher=True)
    store.require_conditions()
    assert not (tmp_path / "map").exists()
    with pytest.raises(BadRequest, match="a web server cannot be written to"):
        open_store(f"{web[0]}/map", timeouts=ONCE).require_conditions()


Ask = Callable[[Store], object]
NO_BUCKET: dict[str, Ask] = {
    "read": lambda store: store.get_tagged("CURRENT", 9),
    "list": lambda store: list(store.list("versions/")),
    "write": lambda store: store.put("blobs/sha256/aa", b""),
    "ask": lambda store: store.require_conditions(),
    "create": lambda store: store.put_new("CURRENT", b""),
    "delete": lambda store: store.delete("CURRENT"),
}


@pytest.mark.parametrize("ask", NO_BUCKET)
def test_a_bucket_that_is_not_there(buckets: BucketServer, ask: str) -> None:
    store = open_store("s3://no-such-bucket/map", timeouts=ONCE)
    with pytest.raises(StoreRefused, match="there is no such bucket") as caught:
        NO_BUCKET[ask](store)
    assert (caught.value.exit_code, caught.value.hint) == (66, "make the bucket first, or correct its name")
    del buckets


BODY = "<?xml version='1.0' encoding='utf-8'?><Error><Code>{}</Code><Message>{}</Message></Error>"
MISSING = "there is no such bucket"


MALFORMED = BODY.format("AuthorizationHeaderMalformed", "expecting 'eu-west-1'")
AZURE = BODY.format("AuthorizationPermissionMismatch", "")
REFUSED = BODY.format("AuthenticationFailed", "Signature did not match")


@pytest.mark.parametrize(
    ("scheme", "status", "body", "says", "hint", "code"),
    [
        ("s3", 404, BODY.format("NoSuchBucket", "The specified bucket does not exist"), MISSING, "make", 66),
        ("s3", 404, BODY.format("NoSuchKey", "NoSuchBucket"), "CURRENT is not there", "", 66),
        ("s3", 404, '{"error": {"message": "The specified bucket does not exist."}}', MISSING, "make", 66),
        ("az", 404, BODY.format("ContainerNotFound", "it does not exist."), MISSING, "make", 66),
        ("az", 404, BODY.format("BlobNotFound", "it does not exist."), "CURRENT is not there", "", 66),
        ("s3", 301, BODY.format("PermanentRedirect", "use the endpoint"), "somewhere else", "AWS_REGION", 75),
        ("s3", 400, MALFORMED, "in another region", "AWS_REGION", 75),
        ("s3", 403, BODY.format("AccessDenied", "it may not exist"), "no permission", "may this account", 75),
        ("az", 403, AZURE, "no permission", "may this account", 75),
        ("az", 403, REFUSED, "key or token is not valid", "are the credentials valid", 75),
        ("s3", 400, BODY.format("InvalidBucketName", ""), "no bucket can have this name", "", 75),
    ],
)
def test_what_stores_say_of_a_bucket(
    scheme: str,
    status: int,
    body: str,
    says: str,
    hint: str,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with closing(StoreProxy("http://127.0.0.1:9")) as server:
        server.rule = lambda *_: Answer(status, {"content-type": "application/xml"}, body.encode())
        for name in ("AWS_ENDPOINT_URL", "AZURE_ENDPOINT"):
            monkeypatch.setenv(name, server.endpoint)
        for name in ("AZURE_STORAGE_ACCOUNT_NAME", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "account")
        store = open_store(f"{scheme}://some/map", timeouts=ONCE)
        with pytest.raises(ShmmapError) as caught:
            store.get_tagged("CURRENT", 99)
        assert says in caught.value.message
        assert hint in caught.value.hint
        assert caught.value.exit_code == code
        assert server.requests()


def test_a_write_is_done_whose_answer_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing asks twice for a write on a condition; what the store has is looked at."""
    kept: dict[str, bytes] = {}

    def rule(asked: Asked, _forward: Forward) -> Answer:
        if asked.method == "PUT":
            if "lost" in asked.path:
                kept[asked.path] = asked.body
            return Answer(500)  # by what is in between
        if asked.path not in kept:
            return Answer(404)
        headers = {"etag": '"a"', "last-modified": "Thu, 01 Jan 2026 00:00:00 GMT"}
        return Answer(200, headers, kept[asked.path])

    with closing(StoreProxy("http://127.0.0.1:9")) as server:
        server.rule = rule
        monkeypatch.setenv("AWS_ENDPOINT_URL", server.endpoint)
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "account")
        store = open_store("s3://some/map", timeouts=ONCE)
        assert store.put_new("lost", b"1")
        assert store.put_if("lost", b"2", {"e_tag": '"a"'})
        with pytest.raises(Offline, match="status 500"):
            store.put_new("refused", b"1")
        server.rule = lambda *_: Answer(500)
        with pytest.raises(Offline, match="lost: refused"):
            store.put_new("lost", b"2")
