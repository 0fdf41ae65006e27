# SPDX-License-Identifier: Apache-2.0
"""The disk tier among processes: used and trimmed by several at once, killed anywhere, on a full disk."""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.accounts import MEMBER, OTHER_USER
from tests.support.daemon_process import ROOT

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.object_tier import ObjectTier

COUNT, LARGEST, LIMIT = 80, 5000, 60_000

USER = """
import random, sys
from tests.process.slow.test_object_tier import LIMIT, objects
from shmmap.origin.remote.object_tier import ObjectTier
from tests.support.map_stores import wait_for_trimming
cache, seed, rounds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
tier, made, random_ = ObjectTier(cache, limit_bytes=LIMIT), objects(), random.Random(seed)
hits = 0
for _ in range(rounds):
    name, data = random_.choice(list(made.items()))
    page = name[0] % 4 == 0
    found = tier.get(name, len(data), is_index=page)
    hits += found is not None
    assert found in (None, data), "wrong bytes"
    if found is None:
        assert tier.put(name, data, is_index=page), "not kept"
        wait_for_trimming()
print(hits, tier.damaged_objects)
"""


def objects() -> dict[bytes, bytes]:
    """Objects by their names, twice as many bytes as the budget is."""
    random_ = random.Random(11)
    made = [random_.randbytes(random_.randrange(1000, LARGEST)) for _ in range(COUNT)]
    return {hashlib.sha256(data).digest(): data for data in made}


def use(cache: Path, seed: int, rounds: int = 400, crash: str = "") -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", USER, str(cache), str(seed), str(rounds)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "SHMMAP_TEST_CRASH": crash},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def check(cache: Path) -> int:
    """Every file is what its name says; returns their bytes."""
    total = 0
    for file in cache.rglob("*"):
        if file.is_file() and not file.name.startswith(".new-"):
            data = file.read_bytes()
            assert hashlib.sha256(data).hexdigest() == file.name
            total += len(data)
    return total


def test_three_processes_at_once(tmp_path: Path) -> None:
    """All trim all the time: the budget is for half of what they use."""
    users = [use(tmp_path, seed) for seed in range(3)]
    for user in users:
        out, errors = user.communicate(timeout=120)
        assert (user.returncode, errors) == (0, "")
        hits, damaged = map(int, out.split())
        assert hits > 20
        assert damaged == 0
    # each trims by what it saw: what another one removes meanwhile is not there for it
    assert 0 < check(tmp_path) <= LIMIT * 17 / 16
    assert not list(tmp_path.rglob(".new-*"))


@pytest.mark.parametrize("step", ["tier.made", "tier.written", "tier.named", "trim.file"])
def test_killed_at_each_step(tmp_path: Path, step: str) -> None:
    """While another one uses it too; what is left half written goes when it is old."""
    other, killed = use(tmp_path, 1, 200), use(tmp_path, 2, crash=f"{step}:7")
    killed.communicate(timeout=120)
    assert killed.returncode == -signal.SIGKILL
    assert other.communicate(timeout=120)[1] == ""
    assert other.returncode == 0
    check(tmp_path)
    left = list(tmp_path.rglob(".new-*"))
    assert len(left) == (1 if step in ("tier.made", "tier.written") else 0)
    for file in left:
        os.utime(file, (1, 1))
    out, errors = use(tmp_path, 5).communicate(timeout=120)
    assert errors == ""
    assert int(out.split()[0]) > 20
    assert check(tmp_path) <= LIMIT * 17 / 16
    assert not list(tmp_path.rglob(".new-*"))


@pytest.mark.root
def test_a_full_disk(private_tmpfs: Callable[[str], str], caplog: pytest.LogCaptureFixture) -> None:
    """Others fill it: nothing more is kept, what is there is served, and it goes on when there is room."""
    cache = Path(private_tmpfs("1m"))
    tier, made = ObjectTier(str(cache), limit_bytes=1 << 30), objects()
    names = iter(made)
    first, second, third = next(names), next(names), next(names)
    assert tier.put(first, made[first])
    stat = os.statvfs(cache)
    filler = cache / "rosbag"
    filler.write_bytes(bytes((stat.f_bavail - 1) * stat.f_frsize))
    for _ in range(3):
        assert not tier.put(second, made[second])
        assert not tier.put(third, made[third], is_index=True)
        assert tier.get(first, len(made[first])) == made[first]
    assert caplog.text.count("objects not kept on disk") == 1
    assert "No space left" in caplog.text
    loader = ObjectTier(
        str(cache), limit_bytes=1 << 30, quiet=True
    )  # the daemon's own pages may all be there
    for _ in range(3):
        assert not loader.put(second, made[second])
    assert caplog.text.count("objects not kept on disk") == 2
    filler.unlink()
    assert tier.put(second, made[second])
    assert tier.get(second, len(made[second])) == made[second]
    check(cache)


@pytest.mark.root
def test_a_disk_that_became_read_only(
    private_tmpfs: Callable[[str], str], caplog: pytest.LogCaptureFixture
) -> None:
    cache = Path(private_tmpfs("1m"))
    tier, made = ObjectTier(str(cache), limit_bytes=1 << 30), objects()
    first, second = list(made)[:2]
    assert tier.put(first, made[first])
    file = next(file for file in cache.rglob("*") if file.is_file())
    os.utime(file, (1, 1))  # it would be marked as used
    subprocess.run(["mount", "-o", "remount,ro", str(cache)], check=True)
    for _ in range(3):
        assert tier.get(first, len(made[first])) == made[first]
        assert not tier.put(second, made[second])
        tier.mark_index_used([first])
    assert caplog.text.count("objects not kept on disk") == 1
    assert "Read-only file system" in caplog.text
    subprocess.run(["mount", "-o", "remount,rw", str(cache)], check=True)
    assert tier.put(second, made[second])


@pytest.mark.root
def test_two_accounts_do_not_share(tmp_path: Path) -> None:
    """Each finds the other's tier, neither uses it, and both go on."""
    program = (
        "import os, sys\n"
        "from shmmap.origin.remote.object_tier import ObjectTier\n"
        "from tests.process.slow.test_object_tier import objects\n"
        "os.setgid(int(sys.argv[2])); os.setuid(int(sys.argv[2]))\n"
        "tier, (name, data) = ObjectTier(sys.argv[1], limit_bytes=1 << 20), next(iter(objects().items()))\n"
        "print(tier.get(name, len(data)) == data, tier.put(name, data), tier.get(name, len(data)) == data)\n"
        "print(tier.problem)"
    )
    cache = tmp_path / "cache"
    cache.mkdir()
    cache.chmod(0o1777)
    for folder in (tmp_path, *tmp_path.parents[:3]):
        if folder != Path("/tmp"):
            os.chmod(folder, 0o755)

    def run(uid: int) -> list[str]:
        done = subprocess.run(
            [sys.executable, "-c", program, str(cache), str(uid)],
            cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    assert run(MEMBER) == ["False True True", ""]
    assert run(MEMBER) == ["True True True", ""]
    found, why = run(OTHER_USER)
    assert found == "False False False"
    assert f"belongs to user {MEMBER}, not to user {OTHER_USER}" in why
    assert run(MEMBER) == ["True True True", ""]
