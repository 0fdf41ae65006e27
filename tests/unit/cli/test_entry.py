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
from shmmap.cli.verbs.run import about

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


@pytest.mark.parametrize(("name", "code"), EXIT_CODES.items())
def test_exit_codes_of_the_contract(
    name: str, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail_with(monkeypatch, getattr(errors, name)("it broke", hint="mend it"))
    assert main(["version"]) == code
    assert capsys.readouterr() == ("", "shmmap: it broke\nhint: mend it\n")


def test_a_missing_package_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where only the client's packages are installed."""
    fail_with(monkeypatch, ModuleNotFoundError("No module named 'xxhash'", name="xxhash"))
    assert main(["version"]) == errors.PackageMissing.exit_code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("shmmap: shmmap version needs the package xxhash, which is not installed\n")


def test_no_hint_no_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fail_with(monkeypatch, errors.MapMissing("no map at /nowhere"))
    assert main(["version"]) == 66
    assert capsys.readouterr().err == "shmmap: no map at /nowhere\n"


def test_a_defect_shows_its_traceback_and_asks_to_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail_with(monkeypatch, ZeroDivisionError("oops"))
    assert main(["version"]) == 70
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert "shmmap: internal error: ZeroDivisionError: oops\nhint: " in said
    assert "report" in said.splitlines()[-1]


def test_ctrl_c_is_quiet(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fail_with(monkeypatch, KeyboardInterrupt())
    assert main(["version"]) == 130
    assert capsys.readouterr() == ("", "")


def test_ctrl_c_within_exec_is_an_exit_code(tmp_path: Path) -> None:
    """As while a dataclass is made."""
    (tmp_path / "interrupted.py").write_text(
        "import sys\nfrom shmmap.cli.program import exit_code_of\n"
        "sys.exit(exit_code_of('shmmap', lambda: exec('raise KeyboardInterrupt')))\n"
    )
    done = subprocess.run([sys.executable, "-m", "interrupted"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "")


def test_an_error_of_cleaning_up_after_ctrl_c_is_no_defect(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = ValueError("it cannot be closed now")
    error.__context__ = KeyboardInterrupt()
    fail_with(monkeypatch, error)
    assert main(["version"]) == 130
    assert capsys.readouterr() == ("", "")


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


def test_a_full_disk_is_no_defect() -> None:
    with open("/dev/full", "w", encoding="utf-8") as full:
        done = subprocess.run(
            [sys.executable, "-m", "shmmap.cli", "version"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == errors.CannotWrite.exit_code
    assert done.stderr.startswith("shmmap: cannot write the output: No space left on device\nhint: ")


def test_closed_streams_are_no_defect() -> None:
    command = f"{sys.executable} -m shmmap.cli"
    done = subprocess.run(
        ["sh", "-c", f"{command} version >&-; echo $?; {command} nonsense 2>&-; echo $?"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("0\n2\n", "")


def test_version_and_its_json(capsys: pytest.CaptureFixture[str]) -> None:
    import json

    import shmmap

    assert main(["version", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["shmmap"] == shmmap.__version__
    assert all(re.fullmatch(r"\d+\.\d+", document[name]) for name in ("protocol", "layout"))
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"shmmap {shmmap.__version__}\n"


@pytest.mark.parametrize("verb", ["status", "ls", "health"])
def test_no_daemon_is_69_and_says_where_it_looked(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SHMMAP_INSTANCE", raising=False)
    assert main([verb, "--shm-dir", str(tmp_path), "--endpoint", "/somewhere/town.sock"]) == 69
    said = capsys.readouterr()
    assert said.out == ""
    assert "'town'" in said.err
    assert str(tmp_path) in said.err


def test_other_instances_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("shmmap.town.statistics", "shmmap.city.statistics", "shmmap.town.0123456789abcdef"):
        (tmp_path / name).touch()
    assert main(["status", "--shm-dir", str(tmp_path), "--instance", "twon"]) == 69
    assert "hint: other instances are there: city, town; name one with --instance" in capsys.readouterr().err
