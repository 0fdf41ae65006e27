# SPDX-License-Identifier: Apache-2.0
"""What becomes of errors: exit code, one line, a hint; no traceback but for defects."""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from shmmap import errors
from shmmap.cli.entry import main
from shmmap.cli.program import _drop_output
from shmmap.cli.verbs.run import about
from shmmap.version import build_version
from tests.unit.conftest import Verb

EXIT_CODES = {
    "ConfigError": 78,
    "BadRequest": 2,
    "MapDataError": 65,
    "MapMissing": 66,
    "NoSocket": 69,
    "SocketPermission": 69,
    "StaleSocket": 69,
    "NoAnswer": 69,
    "ProtocolMismatch": 76,
    "InstanceBusy": 75,
    "CannotStart": 71,
    "OverBudget": 1,
    "UnknownCell": 1,
    "InternalError": 70,
}


def fail_with(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def run(args: argparse.Namespace) -> int:
        raise error

    monkeypatch.setattr(about, "run_version", run)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        *(
            (getattr(errors, name)("it broke", hint="mend it"), code, "shmmap: it broke\nhint: mend it\n")
            for name, code in EXIT_CODES.items()
        ),
        (errors.MapMissing("no map at /nowhere"), 66, "shmmap: no map at /nowhere\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_exit_codes_of_the_contract(
    error: BaseException,
    code: int,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    verb: Verb,
) -> None:
    fail_with(monkeypatch, error)
    assert verb(["version"], code) == ("", said)


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch, verb: Verb) -> None:
    """As where only the client's packages are installed."""
    fail_with(monkeypatch, ModuleNotFoundError("No module named 'xxhash'", name="xxhash"))
    out, err = verb(["version"], errors.PackageMissing.exit_code)
    assert out == ""
    assert err.startswith("shmmap: shmmap version needs the package xxhash, which is not installed\n")


def test_a_defect_shows_its_traceback_and_asks_to_report(monkeypatch: pytest.MonkeyPatch, verb: Verb) -> None:
    fail_with(monkeypatch, ZeroDivisionError("oops"))
    said = verb(["version"], 70).err
    assert "Traceback" in said
    assert "shmmap: internal error: ZeroDivisionError: oops\nhint: " in said
    assert "report" in said.splitlines()[-1]


def test_a_reader_that_went_away_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "shmmap.cli", "version"],
            stdout=writing,
            stderr=subprocess.PIPE,
            check=False,
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.parametrize("words", ["version", "--version", "--help", "query --help"])
def test_a_full_disk_is_no_defect(words: str) -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        done = subprocess.run(
            [sys.executable, "-m", "shmmap.cli", *words.split()],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == errors.CannotWrite.exit_code
    assert done.stderr.startswith("shmmap: cannot write the output: No space left on device\nhint: ")


@pytest.mark.parametrize(
    ("words", "code"),
    [("inspect /nowhere", 66), ("nonsense", 2), ("version", 0), ("merge {0}/a.xyz {0}/b.pcd", 0)],
)
def test_a_full_disk_under_stderr_ends_nothing(tmp_path: Path, words: str, code: int) -> None:
    """Neither the exit code of an error is lost, nor work whose progress cannot be written."""
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    with open("/dev/full", "w", encoding="utf-8") as full:
        command = [sys.executable, "-m", "shmmap.cli", *words.format(tmp_path).split()]
        assert subprocess.run(command, stdout=subprocess.DEVNULL, stderr=full, check=False).returncode == code


def test_closed_streams_are_no_defect() -> None:
    command = f"{sys.executable} -m shmmap.cli"
    done = subprocess.run(
        ["sh", "-c", f"{command} version >&-; echo $?; {command} nonsense 2>&-; echo $?"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("0\n2\n", "")


def test_version_and_its_json(verb: Verb, capsys: pytest.CaptureFixture[str]) -> None:
    import json

    document = json.loads(verb(["version", "--json"]).out)
    assert document["shmmap"] == build_version()
    assert all(re.fullmatch(r"\d+\.\d+", document[name]) for name in ("protocol", "layout"))
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"shmmap {build_version()}\n"


@pytest.mark.parametrize("name", ["status", "ls", "health"])
def test_no_daemon_is_69_and_says_where_it_looked(
    name: str, tmp_path: Path, verb: Verb, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SHMMAP_INSTANCE", raising=False)
    said = verb([name, "--shm-dir", str(tmp_path), "--endpoint", "/somewhere/town.sock"], 69)
    assert said.out == ""
    assert "'town'" in said.err
    assert str(tmp_path) in said.err


def test_other_instances_are_named(tmp_path: Path, verb: Verb) -> None:
    for name in ("shmmap.town.statistics", "shmmap.city.statistics", "shmmap.town.0123456789abcdef"):
        (tmp_path / name).touch()
    said = verb(["status", "--shm-dir", str(tmp_path), "--instance", "twon"], 69).err
    assert "hint: other instances are there: city, town; name one with --instance" in said


def test_output_that_is_dropped_takes_no_descriptor() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as stream:
        before = os.listdir("/proc/self/fd")
        _drop_output(stream)
        assert os.listdir("/proc/self/fd") == before
        stream.write("dropped")
