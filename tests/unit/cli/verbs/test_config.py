# SPDX-License-Identifier: Apache-2.0
"""`shmmap config`: mistakes, origins, and a file to start with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shmmap.cli.entry import main
from tests.unit.conftest import Verb


@pytest.fixture(autouse=True)
def nothing_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    for name in ("SHMMAP_BUDGET", "SHMMAP_MAP_PATH"):
        monkeypatch.delenv(name, raising=False)


def test_from_init_to_check(tmp_path: Path, verb: Verb) -> None:
    file = tmp_path / "shmmap.toml"
    assert main(["config", "init", str(file), "--map", str(tmp_path)]) == 0
    assert verb(["config", "check", str(file)]).out.endswith(f"{file}: good\n")
    assert json.loads(verb(["config", "check", "--json", str(file)]).out) == {"file": str(file), "good": True}
    assert f"{file} exists" in verb(["config", "init", str(file)], 2).err
    assert main(["config", "init", str(tmp_path / "none" / "x.toml")]) == 73


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("bugdet = 3\nmap_path = '/'", 78, "did you mean 'budget"),
        ("map_path = '/'\nworkers = 'many'", 78, ":2: workers must be"),
        ("map_path = '/'\nbudget = -5", 78, ":2: budget cannot be -5"),
        ("map_path = '/'\ncache_size = 'much'", 78, ":2: cache_size: 'much' is no size"),
        ("map_path = '/no/map'", 66, "there is no map at /no/map"),
        ("workers = 1", 78, "no map is named"),
        ("map_path = '/'\ngroup = 'no such group'", 78, "there is no group"),
        ("map_path = ", 78, "Invalid value"),
        ("map_path = 's3://maps/town'\ntrust = '/no/ROOT.json'", 78, "/no/ROOT.json: No such file"),
        ("map_path = 's3://maps/town'\ntrust = '/proc/self/stat'", 78, "no root of trust"),
        ("map_path = 's3://maps/town'\ntrust = true", 78, ":2: trust must be text"),
    ],
)
def test_mistakes(tmp_path: Path, verb: Verb, text: str, code: int, says: str) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text(text)
    assert says in verb(["config", "check", str(file)], code).err


def test_show(tmp_path: Path, verb: Verb, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "config" / "shmmap" / "shmmap.toml"
    file.parent.mkdir(parents=True)
    file.write_text("# mine\nmap_path = '/maps/\"new\"'\n")
    monkeypatch.setenv("SHMMAP_BUDGET", "1M")
    plain = verb(["config", "show"]).out.splitlines()  # the installed one
    assert 'map_path = "/maps/\\"new\\""' in plain
    assert "strict = false" in plain
    with_origins = verb(["config", "show", "--origin", str(file)]).out.splitlines()
    origins = dict(line.split("  # ") for line in with_origins)
    traced = {name.split(" = ")[0]: origin for name, origin in origins.items()}
    assert (traced["map_path"], traced["budget"], traced["strict"]) == (
        f"{file}:2",
        "SHMMAP_BUDGET",
        "default",
    )
    found = json.loads(verb(["config", "show", "--json"]).out)
    assert found["file"] == str(file)
    for name in ("budget", "budget_bytes"):
        assert found["settings"][name] == {"value": 1 << 20, "origin": "SHMMAP_BUDGET"}
