# SPDX-License-Identifier: Apache-2.0
"""Publishing to stores that ignore conditions, or are none: refused before a cell is sent, by every verb."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest

from tests.support.command_line import Verbs
from tests.support.divided_map import DividedMap, make_map
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


@pytest.fixture
def proxy(buckets: BucketServer) -> Iterator[StoreProxy]:
    with closing(StoreProxy(buckets.endpoint)) as proxy:
        yield proxy


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "town", columns=1, rows=1, points=50)


def meeting(rule: Rule, *names: str) -> Rule:
    """Let two publishers meet before each of these writes: both are sent before either is answered."""
    meet = {name: threading.Barrier(2) for name in names}

    def both(asked: Asked, forward: Forward) -> Answer:
        name = asked.path.partition("?")[0].rpartition("/")[2]
        if asked.method == "PUT" and name in meet:
            with suppress(threading.BrokenBarrierError):  # the other one has been refused
                meet[name].wait(20.0)
        return rule(asked, forward)

    return both


@pytest.mark.parametrize("which", ["good", *IGNORING])
def test_two_publishers_at_once_never_lose_a_version(
    which: str, shmmap: Verbs, proxy: StoreProxy, tmp_path: Path
) -> None:
    """At the first version, where both create, and at the next one, where both replace."""
    towns = [make_map(tmp_path / f"town{n}", columns=1, rows=1, points=50 + n) for n in (1, 2)]
    url, env = f"s3://maps/at-once-{which.replace(' ', '-')}", proxy.environment

    def at_once(version: int) -> list[tuple[str, str, int]]:
        proxy.rule = meeting(IGNORING.get(which, honest), f"{version}.json", "CURRENT")
        words = [("publish", town.root, url, "--id-prefix", "/t/", "--json") for town in towns]
        started = [shmmap.start(*some, env=env) for some in words]
        return [(*one.communicate(), one.returncode) for one in started]

    if which != "good":
        if which == "If-Match":
            shmmap("publish", towns[0].root, url, "--id-prefix", "/t/", env=env)
            towns[0].change("0_0.pcd", seed=4)
            proxy.requests()
        done = at_once(2 if which == "If-Match" else 1)
        assert [code for _, _, code in done] == [73, 73]
        assert all(f"the store ignores the conditions of writes ({which})" in said for _, said, _ in done)
        sent = {path.rpartition("/")[2] for method, path in proxy.requests() if method == "PUT"}
        assert sent == {"conditions.json"}
        return
    for version in (1, 2):
        done = at_once(version)
        assert sorted(code for _, _, code in done) == [0, 75]
        listed = shmmap.json("versions", url, env=env)
        served = {one["version"]: one["root"] for one in listed["versions"] if one["state"] != "never served"}
        assert len(served) == version
        made = next(json.loads(text) for text, _, code in done if code == 0)
        assert served[made["version"]] == made["root"]
        for number, town in enumerate(towns):
            town.change("0_0.pcd", seed=7 + number)


def test_every_verb_that_writes_versions_asks_first(
    shmmap: Verbs, proxy: StoreProxy, town: DividedMap, tmp_path: Path
) -> None:
    url, keys, env = "s3://maps/unsafe", tmp_path / "keys", proxy.environment
    shmmap("publish", town.root, url, env=env)
    town.change("0_0.pcd", seed=1)
    shmmap("publish", town.root, url, env=env)
    shmmap("publish", town.root, f"{url}-signed", "--sign", keys, env=env)
    before = shmmap("versions", url, env=env)
    town.change("0_0.pcd", seed=2)
    proxy.requests()
    proxy.rule = IGNORING["If-Match"]
    verbs: list[tuple[str | Path, ...]] = [
        ("publish", town.root, url),
        ("publish", town.root, url, "--resend"),
        ("publish", town.root, url, "--sign", tmp_path / "other"),
        ("publish", town.root, f"{url}-signed", "--sign", keys),
        ("publish", url, "--join", f"{'0' * 16}-1"),
        ("prepare", url, "--shards", "1/1", "--layer", "ndt(leaf=2.0)"),
        ("versions", url, "--rollback", "1"),
        ("versions", f"{url}-signed", "--refresh", "--sign", keys),
        ("versions", f"{url}-signed", "--rotate", "targets", "--sign", keys),
    ]
    for words in verbs:
        said = shmmap(*words, code=73, env=env)
        assert "the store ignores the conditions of writes (If-Match)" in said.splitlines()[0], words
        assert "--sole-publisher" in said
    proxy.rule = with_tags(lambda tag: f"W/{tag}", "PUT", "GET", "HEAD")
    assert "gives weak ETags: a version cannot be replaced safely" in shmmap(*verbs[0], code=73, env=env)
    proxy.rule = with_tags(lambda tag: f"W/{tag}", "GET")
    assert "gives weak ETags: a version cannot be replaced safely" in shmmap(*verbs[0], code=73, env=env)
    proxy.rule = conditional(400)
    assert "takes no writes on conditions (refused (status 400))" in shmmap(*verbs[0], code=73, env=env)
    proxy.rule = page(etag='"1"')
    assert "what the store answers is no map: a page (text/html)" in shmmap(*verbs[0], code=75, env=env)
    sent = {path.rpartition("/")[2] for method, path in proxy.requests() if method not in ("GET", "HEAD")}
    assert sent == {"conditions.json"}
    proxy.rule = IGNORING["If-Match and If-None-Match"]
    assert shmmap("versions", url, env=env) == before
    shmmap("fetch", url, tmp_path / "back", env=env)
    shmmap("versions", url, "--prune", env=env)
    assert {path for method, path in proxy.requests() if method not in ("GET", "HEAD")} == set()
    for rule in (IGNORING["If-Match and If-None-Match"], conditional(400)):
        proxy.rule = rule
        town.change("0_0.pcd", seed=hash(rule) % 1000)
        assert shmmap.json("publish", town.root, url, "--sole-publisher", env=env)["changed"]
    shmmap("versions", url, "--rollback", "1", "--sole-publisher", env=env)
    shmmap("versions", f"{url}-signed", "--refresh", "--sign", keys, "--sole-publisher", env=env)
    assert len(shmmap.json("versions", url, env=env)["versions"]) == 5
    assert "goes with --refresh" in shmmap("versions", url, "--sole-publisher", code=2, env=env)


def test_a_bucket_that_is_not_there(
    shmmap: Verbs, buckets: BucketServer, town: DividedMap, tmp_path: Path
) -> None:
    url, env = "s3://no-such-bucket/town", buckets.environment
    for words in (
        ("publish", town.root, url), ("publish", town.root, url, "--sole-publisher"),
        ("publish", town.root, url, "--sign", tmp_path / "keys"), ("publish", url, "--join", f"{'0' * 16}-1"),
        ("prepare", url, "--shards", "1/1", "--layer", "ndt(leaf=2.0)"), ("versions", url),
        ("versions", url, "--rollback", "1"), ("versions", url, "--prune"), ("fetch", url, tmp_path / "back"),
        ("serve", url, "--instance", "no-bucket", "--runtime-dir", tmp_path, "--shm-dir", tmp_path),
    ):  # fmt: skip
        said = shmmap(*words, code=66, env=env)
        assert "there is no such bucket" in said, words
        assert "make the bucket first, or correct its name" in said, words
