# SPDX-License-Identifier: Apache-2.0
"""What is taken under a root of trust, and what is refused by which name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.command_line import Verbs, files_of
from tests.support.divided_map import DividedMap, make_map
from tests.support.map_stores import BucketServer
from tests.support.published_daemon import flip

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("tuf", reason="tuf is not installed")

from tests.support.published_maps import Signed, in_days


@pytest.fixture
def shmmap(tmp_path: Path) -> Verbs:
    run = Verbs(tmp_path)
    run.environment["XDG_STATE_HOME"] = str(tmp_path / "state")
    return run


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    """As in version 2."""
    made = make_map(tmp_path / "town", columns=2, rows=1, points=100)
    made.change("0_0.pcd", seed=1)
    return made


@pytest.fixture
def store(tmp_path: Path, signed_maps: Path) -> Path:
    return Path(shutil.copytree(signed_maps / "two", tmp_path / "store"))


@pytest.fixture
def keys(tmp_path: Path, signed_maps: Path) -> Path:
    return Path(shutil.copytree(signed_maps / "keys", tmp_path / "keys"))


def test_what_is_signed_is_fetched_whatever_current_says(
    shmmap: Verbs, town: DividedMap, store: Path, keys: Path, tmp_path: Path
) -> None:
    trust = ("--trust", keys / "ROOT.json")
    for number, current in enumerate(("as it is", "older", "damaged", "none")):
        if current == "older":
            entry = json.loads((store / "versions/1.json").read_bytes())
            said = {name: entry[name] for name in ("version", "root", "bytes")}
            (store / "CURRENT").write_text(json.dumps(said))
        elif current == "damaged":
            (store / "CURRENT").write_bytes(b"{")
        elif current == "none":
            (store / "CURRENT").unlink()
        done = shmmap.json("fetch", store, tmp_path / f"back{number}", *trust)
        assert done["version"] == 2
        assert files_of(tmp_path / f"back{number}/pointcloud_map.pcd") == files_of(town.pcd_dir)
    listed = shmmap.json("versions", store, *trust)
    assert listed["current"] == 2
    signed = Signed(store, keys)
    assert listed["valid_until"] == signed.timestamp.signed.expires.timestamp()
    assert [(row["version"], row["state"]) for row in listed["versions"]] == [(2, "current"), (1, "earlier")]
    assert "version 2 is signed, until" in shmmap("versions", store, *trust)


REFUSALS: dict[str, tuple[str, Callable[[Signed], object]]] = {
    "no timestamp": (
        "unsigned: timestamp.json is not there",
        lambda signed: (signed.store / "timestamp.json").unlink(),
    ),
    "timestamp ran out": (
        "expired",
        lambda signed: signed.write("timestamp", expires=in_days(-0.001)),
    ),
    "snapshot ran out": (
        "expired",
        lambda signed: signed.write("snapshot", expires=in_days(-1)),
    ),
    "targets ran out": (
        "expired",
        lambda signed: signed.write("targets", expires=in_days(-1)),
    ),
    "timestamp altered": ("altered", lambda signed: flip(signed.store / "timestamp.json")),
    "snapshot altered": ("altered", lambda signed: flip(signed.store / "2.snapshot.json")),
    "targets altered": ("altered", lambda signed: flip(signed.store / "2.targets.json")),
    "targets of another number": (
        "older",
        lambda signed: shutil.copy(signed.store / "1.targets.json", signed.store / "2.targets.json"),
    ),
    "no snapshot": ("altered", lambda signed: (signed.store / "2.snapshot.json").unlink()),
    "no targets": ("altered", lambda signed: (signed.store / "2.targets.json").unlink()),
    "no JSON": ("altered", lambda signed: (signed.store / "timestamp.json").write_bytes(b"\xff")),
    "too large": (
        "altered",
        lambda signed: (signed.store / "timestamp.json").write_bytes(b" " * 600_000),
    ),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_refused_has_a_name(
    name: str, shmmap: Verbs, store: Path, keys: Path, tmp_path: Path
) -> None:
    cause, change = REFUSALS[name]
    change(Signed(store, keys))
    errors = shmmap("fetch", store, tmp_path / "back", "--trust", keys / "ROOT.json", code=65)
    assert f"refused, {cause}" in errors
    assert (cause[:8] == "unsigned") == ("shmmap publish MAP URL --sign KEYDIR" in errors)
    assert str(store) in errors
    assert not (tmp_path / "back").exists()


def test_a_map_that_others_signed(shmmap: Verbs, signed_maps: Path, keys: Path, tmp_path: Path) -> None:
    errors = shmmap("versions", signed_maps / "other", "--trust", keys / "ROOT.json", code=65)
    assert "refused, foreign root:" in errors
    # also where the right root was put in front of it
    mixed = shutil.copytree(signed_maps / "other", tmp_path / "mixed")
    shutil.copy(keys / "ROOT.json", mixed / "1.root.json")
    assert "refused, altered:" in shmmap("versions", mixed, "--trust", keys / "ROOT.json", code=65)
    # a second root that the first one's keys did not sign
    shutil.copytree(signed_maps / "two", tmp_path / "rotated")
    shutil.copy(signed_maps / "others/ROOT.json", tmp_path / "rotated/2.root.json")
    errors = shmmap("versions", tmp_path / "rotated", "--trust", keys / "ROOT.json", code=65)
    assert "refused, altered:" in errors


def test_what_is_older_than_what_was_seen(
    shmmap: Verbs, store: Path, keys: Path, signed_maps: Path, tmp_path: Path
) -> None:
    trust = ("--trust", keys / "ROOT.json")
    assert shmmap.json("versions", store, *trust)["current"] == 2
    shutil.rmtree(store)
    shutil.copytree(signed_maps / "one", store)
    for _ in range(2):
        errors = shmmap("fetch", store, tmp_path / "back", *trust, code=65)
        assert "refused, older:" in errors
    shutil.rmtree(store)
    shutil.copytree(signed_maps / "two", store)
    assert shmmap.json("versions", store, *trust)["current"] == 2
    shmmap("versions", signed_maps / "one", *trust)  # what was seen elsewhere does not matter


def test_a_root_of_trust_that_is_none(shmmap: Verbs, store: Path, keys: Path, tmp_path: Path) -> None:
    for content in (
        b"",
        b"{}",
        (keys / "ROOT.json").read_bytes().replace(b'"threshold":1', b'"threshold":2'),
    ):
        (tmp_path / "wrong.json").write_bytes(content)
        errors = shmmap("versions", store, "--trust", tmp_path / "wrong.json", code=78)
        assert "no root of trust" in errors
    assert "No such file" in shmmap("versions", store, "--trust", tmp_path / "nowhere.json", code=78)
    assert "too large" in shmmap("versions", store, "--trust", "/dev/zero", code=78)
    for words in (("fetch", store, tmp_path / "back", "--at", "1"), ("versions", store, "--prune")):
        assert "--trust" in shmmap(*words, "--trust", keys / "ROOT.json", code=2)


def test_from_a_bucket(shmmap: Verbs, town: DividedMap, buckets: BucketServer, tmp_path: Path) -> None:
    url, keys = buckets.url("verified"), tmp_path / "made"
    shmmap("publish", town.root, url, "--sign", keys, env=buckets.environment)
    trust = ("--trust", keys / "ROOT.json")
    buckets.requests()
    shmmap("fetch", url, tmp_path / "back", *trust, env=buckets.environment)
    assert files_of(tmp_path / "back/pointcloud_map.pcd") == files_of(town.pcd_dir)
    asked = [path.removeprefix("/maps/verified/") for _, path, _, _ in buckets.requests()]
    assert asked[:4] == ["2.root.json", "timestamp.json", "1.snapshot.json", "1.targets.json"]
    assert not {"CURRENT", "versions/1.json"} & set(asked)
    offline = {**buckets.environment, "AWS_ENDPOINT_URL": "http://127.0.0.1:9"}
    errors = shmmap("versions", url, *trust, env=offline, code=75)
    assert "no answer" in errors
    assert buckets.environment["AWS_SECRET_ACCESS_KEY"] not in errors
