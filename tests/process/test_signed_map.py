# SPDX-License-Identifier: Apache-2.0
"""A signed map: its keys, its metadata, refreshed, killed wherever, by two at a time."""

from __future__ import annotations

import json
import os
import shutil
import signal
import stat
import subprocess
import time
from pathlib import Path

import pytest

from tests.support.command_line import Verbs, locked
from tests.support.divided_map import DividedMap, make_map

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("tuf", reason="tuf is not installed")

from shmmap.origin.remote.opened_store import open_store
from shmmap.origin.remote.verify_version import verify_version
from tests.support.published_maps import Signed, in_days, read_signed


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "town", columns=2, rows=1, points=100)


@pytest.fixture
def store(tmp_path: Path, signed_maps: Path) -> Path:
    """A directory in which the town is published and signed."""
    return Path(shutil.copytree(signed_maps / "one", tmp_path / "store"))


@pytest.fixture
def keys(tmp_path: Path, signed_maps: Path) -> Path:
    """Its keys."""
    return Path(shutil.copytree(signed_maps / "keys", tmp_path / "keys"))


def contents(store: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}


def names(store: Path) -> set[str]:
    return {path.name for path in store.glob("*.json")}


def test_the_first_time_makes_keys_that_no_other_user_reads(store: Path, keys: Path) -> None:
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in keys.iterdir()}
    assert modes.pop("ROOT.json") & 0o444
    assert modes == {"root.pem": 0o600, "targets.pem": 0o600, "online.pem": 0o600}
    signed = read_signed(store, keys)
    assert signed.version == 1
    assert names(store) == {"1.root.json", "1.targets.json", "1.snapshot.json", "timestamp.json"}
    roles = signed.root.signed.roles
    assert roles["snapshot"].keyids == roles["timestamp"].keyids
    assert len({roles[role].keyids[0] for role in ("root", "targets", "timestamp")}) == 3
    assert signed.root.signed.consistent_snapshot
    for role, days in (("root", 3652), ("targets", 365), ("snapshot", 30), ("timestamp", 7)):
        expires = getattr(signed, role).signed.expires
        assert in_days(days - 0.1) < expires <= in_days(days)


def test_versions_are_signed_and_what_is_the_same_is_not_signed_again(
    shmmap: Verbs, town: DividedMap, store: Path, keys: Path
) -> None:
    (keys / "root.pem").unlink()  # off line
    before = contents(store)
    assert not shmmap.json("publish", town.root, store, "--sign", keys)["changed"]
    assert contents(store) == before
    town.change("0_0.pcd", seed=1)
    assert shmmap.json("publish", town.root, store, "--sign", keys)["version"] == 2
    signed = read_signed(store, keys)
    assert (signed.version, signed.timestamp.signed.version) == (2, 2)
    assert {"1.targets.json", "2.targets.json", "1.snapshot.json", "2.snapshot.json"} < names(store)
    done = shmmap.json("versions", store, "--rollback", "1", "--sign", keys)
    assert (done["version"], done["restored"]) == (3, 1)
    assert read_signed(store, keys).version == 3
    # what signed versions long ago goes with them, but for the chain of roots
    there = names(store)
    for name in there - {"2.targets.json"}:
        os.utime(store / name, (1e9, 1e9))
    shmmap("versions", store, "--prune")
    assert there - names(store) == {"1.targets.json", "1.snapshot.json", "2.snapshot.json"}
    assert read_signed(store, keys).version == 3


@pytest.mark.slow
def test_a_map_that_was_not_signed_becomes_signed(shmmap: Verbs, town: DividedMap, tmp_path: Path) -> None:
    shmmap("publish", town.root, tmp_path / "store")
    done = shmmap.json("publish", town.root, tmp_path / "store", "--sign", tmp_path / "keys")
    assert not done["changed"]
    assert read_signed(tmp_path / "store", tmp_path / "keys").version == 1


@pytest.mark.slow
def test_a_signed_map_is_not_changed_without_its_keys(
    shmmap: Verbs, town: DividedMap, store: Path, keys: Path, tmp_path: Path
) -> None:
    town.change("0_0.pcd", seed=1)
    before = contents(store)
    for words in (("publish", town.root, store), ("versions", store, "--rollback", "1")):
        errors = shmmap(*words, code=2)
        assert "is signed" in errors
        assert "--sign KEYDIR" in errors
    errors = shmmap("publish", town.root, store, "--sign", tmp_path / "none", code=2)
    assert "ROOT.json is not there" in errors
    assert not (tmp_path / "none").exists()
    shmmap("publish", town.root, tmp_path / "elsewhere", "--sign", tmp_path / "others")
    errors = shmmap("publish", town.root, store, "--sign", tmp_path / "others", code=65)
    assert "foreign root" in errors
    assert contents(store) == before
    assert "--refresh, --rollback or --rotate" in shmmap("versions", store, "--sign", keys, code=2)
    assert "--sign KEYDIR" in shmmap("versions", store, "--refresh", code=2)
    assert "nothing is signed" in shmmap(
        "versions", tmp_path / "nowhere", "--refresh", "--sign", keys, code=66
    )


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o622])
def test_a_key_that_others_can_use_is_refused(
    mode: int, shmmap: Verbs, town: DividedMap, store: Path, keys: Path
) -> None:
    town.change("0_0.pcd", seed=1)
    (keys / "targets.pem").chmod(mode)
    errors = shmmap("publish", town.root, store, "--sign", keys, code=78)
    assert f"mode {mode:04o}" in errors
    assert f"chmod 600 {keys}/targets.pem" in errors
    assert "PRIVATE" not in errors
    assert read_signed(store, keys).version == 1


@pytest.mark.slow
def test_a_key_that_is_none_or_another_one(shmmap: Verbs, town: DividedMap, store: Path, keys: Path) -> None:
    town.change("0_0.pcd", seed=1)
    whole = (keys / "targets.pem").read_bytes()
    (keys / "targets.pem").write_bytes((keys / "online.pem").read_bytes())
    errors = shmmap("publish", town.root, store, "--sign", keys, code=78)
    assert "not the key that the map's root of trust names for targets" in errors
    for content in (b"", whole[:60], b"\xff" * 100_000):
        (keys / "targets.pem").write_bytes(content)
        assert "no private key" in shmmap("publish", town.root, store, "--sign", keys, code=78)
    (keys / "targets.pem").unlink()
    assert "No such file" in shmmap("publish", town.root, store, "--sign", keys, code=78)
    shmmap("versions", store, "--refresh", "--sign", keys)  # which needs the online key alone
    (keys / "targets.pem").write_bytes(whole)
    (keys / "targets.pem").chmod(0o600)
    assert shmmap.json("publish", town.root, store, "--sign", keys)["version"] == 2
    read_signed(store, keys)


def test_a_refresh_signs_what_runs_out(shmmap: Verbs, store: Path, keys: Path) -> None:
    for name in ("root.pem", "targets.pem"):
        (keys / name).unlink()
    done = shmmap.json("versions", store, "--refresh", "--sign", keys)
    assert done["version"] == 1
    signed = read_signed(store, keys)
    assert (signed.timestamp.signed.version, signed.snapshot.signed.version) == (2, 1)
    assert done["valid_until"]["timestamp"] == signed.timestamp.signed.expires.isoformat()
    # weeks later: both have run out, and a snapshot was left by a run that was killed
    signed.write("timestamp", expires=in_days(-20))
    signed.write("snapshot", expires=in_days(-1))
    (store / "2.snapshot.json").write_bytes(b"left")
    assert "version 1 is signed" in shmmap("versions", store, "--refresh", "--sign", keys)
    signed = read_signed(store, keys)
    assert (signed.timestamp.signed.version, signed.snapshot.signed.version) == (3, 3)
    assert signed.timestamp.signed.expires > in_days(6.9)
    assert signed.snapshot.signed.expires > in_days(29.9)


@pytest.mark.slow
def test_publishing_the_same_signs_targets_again_before_they_run_out(
    shmmap: Verbs, town: DividedMap, store: Path, keys: Path
) -> None:
    Signed(store, keys).write("targets", expires=in_days(100))
    assert not shmmap.json("publish", town.root, store, "--sign", keys)["changed"]
    signed = read_signed(store, keys)
    assert (signed.version, signed.targets.signed.version) == (1, 2)
    assert signed.targets.signed.expires > in_days(364)


@pytest.mark.slow
def test_damaged_metadata_is_not_built_upon(shmmap: Verbs, town: DividedMap, store: Path, keys: Path) -> None:
    town.change("0_0.pcd", seed=1)
    for name in ("timestamp.json", "1.snapshot.json", "1.targets.json"):
        whole = (store / name).read_bytes()
        for damaged in (b"", b"{", whole.replace(b'"version":1', b'"version":7')):
            (store / name).write_bytes(damaged)
            errors = shmmap("publish", town.root, store, "--sign", keys, code=65)
            assert "refused" in errors
            assert name in errors
        (store / name).write_bytes(whole)
    assert shmmap.json("publish", town.root, store, "--sign", keys)["version"] == 2


# --- killed, and two at a time ------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("label", ["keys", "root", "metadata", "timestamp", "signed"])
def test_killed_the_first_time_it_goes_on(
    label: str, shmmap: Verbs, town: DividedMap, tmp_path: Path
) -> None:
    words = ("publish", town.root, tmp_path / "store", "--sign", tmp_path / "keys")
    shmmap(*words, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": f"sign.{label}"})
    assert not (tmp_path / "store/CURRENT").exists()
    shmmap(*words)
    assert not list((tmp_path / "keys").glob(".*"))
    assert read_signed(tmp_path / "store", tmp_path / "keys").version == (
        1 if label in ("keys", "root", "signed") else 2
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "label"),
    [
        ("publish", "sign.metadata"),
        ("publish", "sign.metadata:2"),
        ("publish", "sign.timestamp"),
        ("publish", "sign.signed"),
        ("publish", "sign.switched"),
        ("rollback", "sign.timestamp"),
        ("rollback", "sign.switch"),
    ],
)
def test_killed_anywhere_one_version_is_signed_and_whole(
    label: str, verb: str, shmmap: Verbs, town: DividedMap, store: Path, keys: Path, tmp_path: Path
) -> None:
    town.change("0_0.pcd", seed=1)
    words: tuple[str | Path, ...] = ("publish", town.root, store, "--sign", keys)
    before = 1
    if verb == "rollback":
        shmmap(*words)
        words, before = ("versions", store, "--rollback", "1", "--sign", keys), 2
    shmmap(*words, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
    is_signed = label in ("sign.signed", "sign.switch", "sign.switched")
    assert Signed(store, keys).version == before + is_signed
    if label == "sign.signed":  # what is signed must not be removed as if it had never been served
        assert "CURRENT says 1" in shmmap("versions", store, "--prune", code=2)
    shmmap("versions", store, "--refresh", "--sign", keys)  # repairs entry and CURRENT
    assert read_signed(store, keys).version == before + is_signed
    shmmap(*words)
    read_signed(store, keys)
    shmmap("versions", store, "--prune")
    shmmap("fetch", store, tmp_path / "back")


@pytest.mark.slow
@pytest.mark.parametrize("label", ["sign.metadata", "sign.timestamp", "sign.repaired"])
def test_a_refresh_that_is_killed(label: str, shmmap: Verbs, store: Path, keys: Path) -> None:
    Signed(store, keys).write("snapshot", expires=in_days(1))
    (store / "CURRENT").unlink()
    words = ("versions", store, "--refresh", "--sign", keys)
    shmmap(*words, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
    assert Signed(store, keys).version == 1
    shmmap(*words)
    assert read_signed(store, keys).snapshot.signed.expires > in_days(29)


@pytest.mark.slow
def test_entry_and_current_are_repaired(shmmap: Verbs, town: DividedMap, store: Path, keys: Path) -> None:
    for seed, damage in enumerate(("entry", "other entry", "no current", "later")):
        town.change("0_0.pcd", seed=seed)
        shmmap("publish", town.root, store, "--sign", keys)
        signed = read_signed(store, keys)
        entry = store / f"versions/{signed.version}.json"
        if damage == "entry":
            entry.unlink()
            (store / "CURRENT").write_text(json.dumps({**signed.current, "version": 1}))
        elif damage == "other entry":
            entry.write_text(json.dumps({**json.loads(entry.read_bytes()), "root": "0" * 64}))
            (store / "CURRENT").unlink()
        elif damage == "no current":
            (store / "CURRENT").unlink()
        else:
            (store / "CURRENT").write_text(json.dumps({**signed.current, "version": 77}))
        shmmap("versions", store, "--refresh", "--sign", keys)
        assert read_signed(store, keys).version == signed.version


def before_its_timestamp(shmmap: Verbs, town: DividedMap, store: Path, keys: Path) -> subprocess.Popen[str]:
    """A publisher that has written its snapshot and waits for the store's lock."""
    slow = shmmap.start("publish", town.root, store, "--sign", keys)
    while not (store / "2.snapshot.json").exists():
        assert slow.poll() is None
        time.sleep(0.01)
    return slow


@pytest.mark.slow
def test_a_refresh_that_comes_between_costs_nothing(
    shmmap: Verbs, town: DividedMap, store: Path, keys: Path
) -> None:
    town.change("0_0.pcd", seed=1)
    with locked(store):
        slow = before_its_timestamp(shmmap, town, store, keys)
        Signed(store, keys).write("timestamp", version=2)
    _, errors = slow.communicate()
    assert slow.returncode == 0, errors
    signed = read_signed(store, keys)
    assert (signed.version, signed.timestamp.signed.version) == (2, 3)


@pytest.mark.slow
def test_the_slower_of_two_publishers_changes_nothing(
    shmmap: Verbs, town: DividedMap, store: Path, keys: Path
) -> None:
    town.change("0_0.pcd", seed=1)
    with locked(store):
        slow = before_its_timestamp(shmmap, town, store, keys)
        other = Signed(store, keys)
        other.target.unrecognized_fields["custom"]["map_version"] = 9
        other.write_all(5, timestamp=2)
    _, errors = slow.communicate()
    assert slow.returncode == 75, errors
    assert "another publisher has changed" in errors
    assert Signed(store, keys).version == 9
    assert shmmap.json("publish", town.root, store, "--sign", keys)["version"] == 10
    read_signed(store, keys)


# --- other keys ---------------------------------------------------------------------------------------


def key_of(keys: Path, name: str) -> bytes:
    return (keys / f"{name}.pem").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("role", ["root", "targets", "snapshot", "timestamp"])
def test_a_rotated_key_signs_from_then_on_and_vehicles_follow(
    role: str, shmmap: Verbs, town: DividedMap, store: Path, keys: Path
) -> None:
    trust = ("--trust", keys / "ROOT.json")
    assert shmmap.json("versions", store, *trust)["current"] == 1
    before = {name: key_of(keys, name) for name in ("root", "targets", "online")}
    first = Signed(store, keys)
    done = shmmap.json("versions", store, "--rotate", role, "--sign", keys)
    name = {"snapshot": "online", "timestamp": "online"}.get(role, role)
    roles = ["snapshot", "timestamp"] if name == "online" else [role]
    assert sorted(done["roles"]) == roles
    assert done["root"] == (2 if role == "root" else 3)
    assert done["key"] == str(keys / f"{name}.pem")
    assert {one for one in before if key_of(keys, one) != before[one]} == {name}
    assert sorted(path.name for path in keys.iterdir()) == [
        "ROOT.json", "online.pem", "root.pem", "targets.pem",
    ]  # fmt: skip
    assert stat.S_IMODE((keys / f"{name}.pem").stat().st_mode) == 0o600
    signed = read_signed(store, keys)
    assert signed.version == 1
    for one in ("root", "targets", "snapshot", "timestamp"):
        old, new = (found.root.signed.roles[one].keyids for found in (first, signed))
        assert (set(old).isdisjoint(new), len(new)) == (one in roles, 1)
    assert shmmap.json("versions", store, *trust)["current"] == 1, "one that has seen the first root"
    town.change("0_0.pcd", seed=1)
    assert shmmap.json("publish", town.root, store, "--sign", keys)["version"] == 2
    shmmap("versions", store, "--refresh", "--sign", keys)
    read_signed(store, keys)
    with_an_empty_memory = {"XDG_STATE_HOME": str(keys / "none")}
    assert shmmap.json("versions", store, *trust, env=with_an_empty_memory)["current"] == 2
    # the old key is none any more
    (keys / f"{name}.pem").write_bytes(before[name])
    words = ("--rotate", "root") if role == "root" else ("--rollback", "1")
    errors = shmmap("versions", store, *words, "--sign", keys, code=78)
    assert "is not the key that the map's root of trust names for" in errors


@pytest.mark.slow
@pytest.mark.parametrize(
    ("role", "label"),
    [
        ("targets", "sign.nextkey"),
        ("targets", "sign.nextroot"),
        ("targets", "sign.metadata"),
        ("targets", "sign.metadata:2"),
        ("targets", "sign.timestamp"),
        ("targets", "sign.renewed"),
        ("targets", "sign.nextroot:2"),
        ("targets", "sign.rotated"),
        ("targets", "sign.timestamp:2"),
        ("timestamp", "sign.nextroot"),
        ("timestamp", "sign.metadata"),
        ("timestamp", "sign.timestamp"),
        ("root", "sign.nextkey"),
        ("root", "sign.nextroot"),
    ],
)
def test_a_rotation_killed_anywhere_leaves_a_valid_map(
    role: str, label: str, shmmap: Verbs, town: DividedMap, store: Path, keys: Path, tmp_path: Path
) -> None:
    first = (keys / "ROOT.json").read_bytes()

    def taken(version: int) -> bool:
        """Whether a vehicle that trusts the first root takes this version."""
        verified = verify_version(open_store(str(store)), first, str(tmp_path / "state"))
        return verified.current.version == version

    before = Signed(store, keys).root.signed.roles[role].keyids
    words = ("versions", store, "--rotate", role, "--sign", keys)
    shmmap(*words, code=-signal.SIGKILL, env={"SHMMAP_TEST_CRASH": label})
    assert read_signed(store, keys).version == 1
    assert taken(1)
    # a version published in between is signed by the keys named then
    town.change("0_0.pcd", seed=1)
    assert shmmap.json("publish", town.root, store, "--sign", keys)["version"] == 2
    assert read_signed(store, keys).version == 2
    shmmap(*words)
    signed = read_signed(store, keys)
    assert signed.version == 2
    assert len(signed.root.signed.roles[role].keyids) == 1
    assert set(before).isdisjoint(signed.root.signed.roles[role].keyids)
    assert not list(keys.glob("*.next.pem"))
    assert taken(2)


@pytest.mark.slow
def test_what_a_rotation_needs(shmmap: Verbs, store: Path, keys: Path, tmp_path: Path) -> None:
    before = contents(store)
    (keys / "root.pem").rename(tmp_path / "root.pem")
    errors = shmmap("versions", store, "--rotate", "targets", "--sign", keys, code=78)
    assert f"{keys}/root.pem is not there" in errors
    assert "it is offline" in errors
    assert "--sign KEYDIR" in shmmap("versions", store, "--rotate", "targets", code=2)
    assert "invalid choice" in shmmap("versions", store, "--rotate", "other", "--sign", keys, code=2)
    assert "nothing is signed" in shmmap(
        "versions", tmp_path / "nowhere", "--rotate", "root", "--sign", keys, code=66
    )
    assert contents(store) == before
    assert not list(keys.glob("*.next.pem"))


@pytest.mark.slow
def test_a_key_that_is_lost_is_rotated(shmmap: Verbs, town: DividedMap, store: Path, keys: Path) -> None:
    (keys / "online.pem").unlink()
    assert "No such file" in shmmap("versions", store, "--refresh", "--sign", keys, code=78)
    shmmap("versions", store, "--rotate", "timestamp", "--sign", keys)
    assert read_signed(store, keys).version == 1
    town.change("0_0.pcd", seed=1)
    assert shmmap.json("publish", town.root, store, "--sign", keys)["version"] == 2
    assert shmmap.json("versions", store, "--trust", keys / "ROOT.json")["current"] == 2


@pytest.mark.slow
def test_a_publisher_with_the_old_key_leaves_a_valid_map(
    shmmap: Verbs, town: DividedMap, store: Path, keys: Path, tmp_path: Path
) -> None:
    """Its run began before the rotation, and ends in the midst of it, or after."""
    old = Path(shutil.copytree(keys, tmp_path / "old"))
    town.change("0_0.pcd", seed=1)
    with locked(store):  # it holds back timestamps: the one of the publisher, and those of the rotation
        slow = before_its_timestamp(shmmap, town, store, old)
        rotation = shmmap.start("versions", store, "--rotate", "targets", "--sign", keys)
        while not (store / "2.root.json").exists():
            assert rotation.poll() is None
            time.sleep(0.01)
    _, errors = slow.communicate()
    _, other_errors = rotation.communicate()
    assert rotation.returncode == 0, other_errors
    assert slow.returncode in (0, 78), errors  # quick enough, or too late
    signed = Signed(store, keys)
    assert signed.version == (2 if slow.returncode == 0 else 1)
    assert shmmap.json("versions", store, "--trust", keys / "ROOT.json")["current"] == signed.version
    errors = shmmap("publish", town.root, store, "--sign", old, code=78)
    assert "if that was rotated elsewhere, the new key belongs here" in errors
