# SPDX-License-Identifier: Apache-2.0
"""Without a usable XDG_RUNTIME_DIR, as in an ssh session or a container, an ordinary user's daemon serves."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT, until
from tests.support.divided_map import DividedMap, make_map

UID = 50000 + os.getpid() % 10000  # of each process that tests another one
PLACE = Path(f"/tmp/shmmap-{UID}")  # what is tested


@pytest.fixture
def readable_map(tmp_path: Path) -> DividedMap:
    for above in (tmp_path, *tmp_path.parents[:2]):
        above.chmod(0o755)
    return make_map(tmp_path / "map", columns=2, rows=2)


@pytest.fixture
def place() -> Iterator[Path]:
    assert not os.path.lexists(PLACE)
    yield PLACE
    if PLACE.is_symlink() or PLACE.is_file():
        PLACE.unlink()
    elif PLACE.exists():
        for path in PLACE.iterdir():
            path.unlink()
        PLACE.rmdir()


def environment(tmp_path: Path, **more: str) -> dict[str, str]:
    names = ("PATH", "NUMBA_CACHE_DIR")
    return {name: os.environ[name] for name in names if name in os.environ} | {
        "HOME": str(tmp_path), "PYTHONPATH": str(ROOT), **more,
    }  # fmt: skip


def command(*words: str) -> list[str]:
    """Run by an account that has no name; the right to read lets it start this Python, wherever that is."""
    return [
        "setpriv", f"--reuid={UID}", f"--regid={UID}", "--clear-groups", "--inh-caps=-all,+dac_read_search",
        "--ambient-caps=+dac_read_search", sys.executable, "-m", "shmmap.cli", *words,
    ]  # fmt: skip


def ask(tmp_path: Path, *words: str, **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*words), env=environment(tmp_path, **more), cwd="/", capture_output=True, text=True,
        timeout=60,
    )  # fmt: skip


@pytest.mark.root
@pytest.mark.parametrize("given", [None, "relative/place", "/run/user/1"])
def test_it_is_found_in_tmp(readable_map: DividedMap, tmp_path: Path, place: Path, given: str | None) -> None:
    """Also by clients that have XDG_RUNTIME_DIR while the daemon had none, and by each kind of verb."""
    log = tmp_path / "log.txt"
    instance = f"no-xdg-{os.getpid()}"
    served = {} if given is None or given.startswith("/") else {"XDG_RUNTIME_DIR": given}
    asked = {} if given is None else {"XDG_RUNTIME_DIR": given}
    with log.open("wb") as out:
        process = subprocess.Popen(
            command("serve", str(readable_map.root), "--instance", instance, "--cache-size", "0"),
            env=environment(tmp_path, **served), cwd="/",
            stdin=subprocess.DEVNULL, stdout=out, stderr=out,
        )  # fmt: skip
    try:
        until(lambda: "ready endpoint" in log.read_text() or process.poll() is not None, log.read_text)
        assert f"runtime directory path={place} reason=" in log.read_text()
        assert place.stat().st_mode & 0o777 == 0o700
        assert place.stat().st_uid == UID
        for words in (("query", "--circle", "0,0,5"), ("clients",), ("health",), ("status",)):
            done = ask(tmp_path, *words, "--instance", instance, **asked)
            assert done.returncode == 0, (words, done.stderr)
        done = ask(tmp_path, "query", "--circle", "0,0,5", SHMMAP_INSTANCE=instance, **asked)
        assert done.returncode == 0, done.stderr
    finally:
        process.terminate()
        process.wait()
    assert [path.name for path in place.iterdir()] == []


@pytest.mark.root
@pytest.mark.parametrize("what", ["another user's", "a link", "a file", "open to others"])
def test_what_is_not_one_s_own_is_refused(
    readable_map: DividedMap, tmp_path: Path, place: Path, what: str
) -> None:
    """By the daemon; clients pass it over, and `doctor` says what `serve` would say."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    os.chown(elsewhere, UID, UID)
    if what == "a link":
        place.symlink_to(elsewhere)
    elif what == "a file":
        place.touch()
    else:
        place.mkdir()
        if what == "open to others":
            os.chown(place, UID, UID)
            place.chmod(0o777)
    done = ask(tmp_path, "serve", str(readable_map.root))
    assert done.returncode == 71, done.stderr
    assert f"runtime directory {place}: " in done.stderr
    assert "--runtime-dir" in done.stderr
    assert list(elsewhere.iterdir()) == []
    done = ask(tmp_path, "doctor")
    assert f"{place}: " in done.stdout
    done = ask(tmp_path, "query", "--circle", "0,0,5")
    assert done.returncode == 69
    assert str(place) not in done.stderr
