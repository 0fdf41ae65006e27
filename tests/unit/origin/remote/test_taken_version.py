# SPDX-License-Identifier: Apache-2.0
"""What was taken is remembered whole; what may be taken next; nothing unreadable is lost."""

from __future__ import annotations

import hashlib
import itertools
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.errors import CannotWrite
from shmmap.origin.remote.map_versions import Current
from shmmap.origin.remote.taken_version import TakenVersion, TakenVersionFile, refusal_of

URL = "s3://bucket/town"
TAKEN = TakenVersion(
    "default", URL, "", 7, b"root of seven", 1_800_000_000.5, 1_799_999_000.0, 1_800_500_000.0
)


def file(directory: Path, *, instance: str = "default", url: str = URL, trust: str = "") -> TakenVersionFile:
    return TakenVersionFile(str(directory), instance, url, trust)


def test_what_was_taken_comes_back(tmp_path: Path) -> None:
    assert file(tmp_path).load() is None
    file(tmp_path).save(TAKEN)
    one = file(tmp_path)
    assert one.load() == TAKEN
    assert one.problem == ""
    newer = msgspec.structs.replace(TAKEN, version=8, root=b"root of eight" * 100_000)
    one.save(newer)
    assert file(tmp_path).load() == newer
    assert newer.current == Current(8, hashlib.sha256(newer.root).hexdigest(), 1_300_000)


def test_each_instance_url_and_trust_has_its_own(tmp_path: Path) -> None:
    others = {"instance": "second", "url": URL + "/", "trust": "ab" * 32}
    file(tmp_path).save(TAKEN)
    for name, value in others.items():
        one = file(tmp_path, **{name: value})
        assert one.load() is None
        assert one.problem == ""
        one.save(msgspec.structs.replace(TAKEN, **{name: value}))
    assert file(tmp_path).load() == TAKEN
    assert len(list((tmp_path / "origins").iterdir())) == 4


def test_the_file_byte_by_byte(tmp_path: Path) -> None:
    """Read by what the module's head says, without the module."""
    one = file(tmp_path)
    one.save(TAKEN)
    key = b"\x93\xa7default" + bytes([0xA0 + len(URL)]) + URL.encode() + b"\xa0"
    path = tmp_path / "origins" / f"{hashlib.sha256(key).hexdigest()[:32]}.taken"
    assert one.path == str(path)
    data = path.read_bytes()
    assert data[:8] == b"SHMTAKEN"
    assert struct.unpack_from("<I", data, 8) == (1,)
    assert data[-32:] == hashlib.sha256(data[:-32]).digest()
    assert msgspec.msgpack.decode(data[12:-32]) == {
        "instance": "default", "url": URL, "trust": "", "version": 7, "root": b"root of seven",
        "taken_s": 1_800_000_000.5, "signed_s": 1_799_999_000.0, "expires_s": 1_800_500_000.0,
    }  # fmt: skip


def sealed(head: bytes, body: bytes) -> bytes:
    return head + body + hashlib.sha256(head + body).digest()


def damages(true: bytes) -> dict[str, bytes]:
    head, body = true[:12], true[12:-32]
    other = msgspec.msgpack.encode(msgspec.structs.replace(TAKEN, url="s3://other"))
    return {
        "empty": b"", "short": true[:-1], "long": true + b"x", "zeros": bytes(len(true)),
        "flipped": true[:40] + bytes([true[40] ^ 1]) + true[41:], "other file": b"something else" * 10,
        "no map": sealed(head, b"\x00"), "half a map": sealed(head, body[:-9]),
        "of another": sealed(head, other), "huge": bytes(17 << 20),
        "later format": sealed(b"SHMTAKEN" + struct.pack("<I", 2), body),
    }  # fmt: skip


@pytest.mark.parametrize("damage", list(damages(bytes(100))))
def test_what_cannot_be_read_is_said_and_kept(tmp_path: Path, damage: str) -> None:
    one = file(tmp_path)
    one.save(TAKEN)
    wrong = damages(Path(one.path).read_bytes())[damage]
    Path(one.path).write_bytes(wrong)
    assert one.load() is None
    (kept,) = (tmp_path / "origins").iterdir()
    assert kept.read_bytes() == wrong
    assert f"kept as {kept}" in one.problem
    assert ("format is 2" in one.problem) == (damage == "later format")
    assert one.load() is None
    assert one.problem == "", "there is none now"
    one.save(TAKEN)
    assert one.load() == TAKEN
    assert kept.exists()


def test_any_flipped_bit_is_noticed(tmp_path: Path) -> None:
    one = file(tmp_path)
    one.save(TAKEN)
    path = Path(one.path)
    true = path.read_bytes()
    for at in range(len(true)):
        path.write_bytes(true[:at] + bytes([true[at] ^ 0x10]) + true[at + 1 :])
        assert one.load() is None, at
        assert one.problem


def test_what_is_no_file_there(tmp_path: Path) -> None:
    one = file(tmp_path)
    os.makedirs(one.path)
    assert one.load() is None
    assert "directory" in one.problem
    with pytest.raises(CannotWrite):
        one.save(TAKEN)
    os.rmdir(one.path)
    os.mkfifo(one.path)
    assert one.load() is None  # and does not wait for a writer
    assert "kept as" in one.problem
    one.save(TAKEN)
    assert one.load() == TAKEN


def test_a_directory_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file")
    one = file(tmp_path / "state")
    assert one.load() is None
    with pytest.raises(CannotWrite, match="state"):
        one.save(TAKEN)


@pytest.mark.parametrize(("step", "now"), [("taken.head", 7), ("taken.written", 7), ("taken.named", 8)])
def test_killed_anywhere_the_one_before_or_the_new_one_is_there(tmp_path: Path, step: str, now: int) -> None:
    file(tmp_path).save(TAKEN)
    program = (
        "import sys; from shmmap.origin.remote.taken_version import TakenVersion, TakenVersionFile as F\n"
        f"taken = TakenVersion('default', {URL!r}, '', 8, b'root of eight', 1.0)\n"
        f"F(sys.argv[1], 'default', {URL!r}).save(taken)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], env={**os.environ, "SHMMAP_TEST_CRASH": step}
    )
    assert done.returncode == -signal.SIGKILL
    found = file(tmp_path).load()
    assert found is not None
    assert (found.version, found.root) == (now, {7: b"root of seven", 8: b"root of eight"}[now])
    assert len(list((tmp_path / "origins").iterdir())) == 1, "nothing half written is left"


def test_a_full_disk_leaves_the_one_before(tmp_path: Path) -> None:
    one = file(tmp_path)
    one.save(TAKEN)
    program = (
        "import resource, sys\n"
        "from shmmap.origin.remote.taken_version import TakenVersion, TakenVersionFile as F\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        f"taken = TakenVersion('default', {URL!r}, '', 8, bytes(5000), 1.0)\n"
        f"F(sys.argv[1], 'default', {URL!r}).save(taken)"
    )
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 1
    assert "CannotWrite" in done.stderr
    assert one.load() == TAKEN
    assert len(list((tmp_path / "origins").iterdir())) == 1


# --- what may be taken --------------------------------------------------------------------------------

OTHER = "ff" * 32


@pytest.mark.parametrize(
    ("offered", "accept", "problem"),
    [
        (TAKEN.current, 0, ""),
        (TAKEN.current, 7, ""),
        (Current(8, OTHER, 9), 0, ""),
        (Current(8, TAKEN.current.root, 9), 0, ""),
        (Current(1 << 62, OTHER, 9), 3, ""),
        (Current(7, OTHER, 9), 0, "offers another map as version 7, which was taken on 2027-01-15"),
        (Current(7, OTHER, 9), 7, "offers another map as version 7"),
        (Current(6, OTHER, 9), 0, "offers version 6, older than version 7, which was taken on 2027"),
        (Current(6, TAKEN.current.root, 9), 0, "offers version 6, older"),
        (Current(6, OTHER, 9), 5, "offers version 6, older"),
        (Current(6, OTHER, 9), 6, ""),
    ],
)
def test_which_offers_are_refused(offered: Current, accept: int, problem: str) -> None:
    refused = refusal_of(TAKEN, offered, accept=accept)
    if not problem:
        assert refused is None
        return
    assert refused is not None
    assert f"{URL} {problem}" in refused.message
    assert refused.cause == ("altered" if "another map" in problem else "older")
    assert refused.hint


def test_the_first_one_is_taken_whatever_its_number() -> None:
    for offered, accept in itertools.product((Current(1, OTHER, 9), Current(1 << 62, OTHER, 9)), (0, 1, 5)):
        assert refusal_of(None, offered, accept=accept) is None


@given(offers=st.lists(st.tuples(st.integers(1, 9), st.sampled_from(["aa" * 32, "bb" * 32])), max_size=20))
def test_without_a_person_a_version_never_goes_back(offers: list[tuple[int, str]]) -> None:
    taken: TakenVersion | None = None
    for version, root in offers:
        before = taken
        if refusal_of(taken, Current(version, root, 1)) is None:
            taken = msgspec.structs.replace(TAKEN, version=version, root=root.encode())
        assert before is None or (taken is not None and taken.version >= before.version)
        if before is not None and taken is not None and taken.version == before.version:
            assert taken is before
