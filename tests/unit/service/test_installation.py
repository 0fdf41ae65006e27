# SPDX-License-Identifier: Apache-2.0
"""What `shmmap unit` writes and prints: into a directory of the test's own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from shmmap.cli.entry import main
from shmmap.errors import BadRequest, MapMissing
from shmmap.service import installation, program
from shmmap.service.installation import PlannedFile, configuration, plan_system, plan_user, unit_text, write
from shmmap.service.program import daemon_command, hidden_directories, outermost, quoted
from shmmap.service.shipped_files import shipped_names, shipped_text
from tests.support.daemon_process import ROOT

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def test_a_service_for_the_machine(tmp_path: Path) -> None:
    planned = plan_system(root=str(tmp_path))
    names = {str(one.path.relative_to(tmp_path)) for one in planned}
    assert names >= {
        "etc/systemd/system/shmmapd.service",
        "etc/systemd/system/shmmapd.socket",
        "etc/systemd/system/shmmapd@.service",
        "etc/systemd/system/shmmapd@.socket",
        "etc/sysusers.d/shmmap.conf",
        "etc/tmpfiles.d/shmmap.conf",
        "etc/shmmap/shmmap.toml",
    }
    assert {one.action for one in planned} == {"new"}
    write(planned)
    assert {one.action for one in plan_system(root=str(tmp_path))} == {"same", "kept"}
    unit = (tmp_path / "etc/systemd/system/shmmapd.service").read_text()
    assert f"\nExecStart={daemon_command()} --config %E/shmmap/shmmap.toml\n" in unit
    assert sorted(path.name for path in tmp_path.rglob(".*")) == []


def test_units_are_replaced_and_the_configuration_is_kept(tmp_path: Path) -> None:
    write(plan_system(root=str(tmp_path)))
    unit = tmp_path / "etc/systemd/system/shmmapd.service"
    config = tmp_path / "etc/shmmap/shmmap.toml"
    unit.write_text("old")
    config.write_text("mine")
    actions = {one.path: one.action for one in plan_system(root=str(tmp_path))}
    assert (actions[unit], actions[config]) == ("changed", "kept")
    write(plan_system(root=str(tmp_path)))
    assert unit.read_text() == unit_text("system/shmmapd.service")
    assert config.read_text() == "mine"


def test_a_map_and_what_would_hide_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drop_in = tmp_path / "etc/systemd/system/shmmapd.service.d/20-map.conf"
    the_map = tmp_path / "a map"
    the_map.mkdir()
    monkeypatch.setattr(installation, "check_readable", lambda: None)  # this Python may lie anywhere
    for hidden in (True, False):
        monkeypatch.setattr(program, "_HIDDEN", (str(tmp_path),) if hidden else ())
        planned = plan_system(str(the_map), str(tmp_path))
        write(planned)
        text = drop_in.read_text()
        assert (f'\nBindReadOnlyPaths="{the_map}"\n' in text) == hidden
        config = tomllib.loads((tmp_path / "etc/shmmap/shmmap.toml").read_text())
        assert config == {"map_path": str(the_map), "group": "shmmap"}
    with pytest.raises(MapMissing, match="no-map"):
        plan_system(str(tmp_path / "no-map"), str(tmp_path))


def test_a_user_s_service(tmp_path: Path) -> None:
    planned = plan_user(str(tmp_path), str(tmp_path / "config"))
    write(planned)
    assert sorted(str(one.path.relative_to(tmp_path / "config")) for one in planned) == [
        "shmmap/shmmap.toml",
        "systemd/user/shmmapd.service",
        "systemd/user/shmmapd.socket",
    ]
    assert tomllib.loads(planned[-1].path.read_text()) == {"map_path": str(tmp_path)}


@pytest.mark.parametrize("path", ["/maps/a\\b", '/maps/"x"', "/maps/käse", "/maps/a\tb", r"/maps/\1"])
def test_any_path_can_be_configured(path: str) -> None:
    assert tomllib.loads(configuration(path))["map_path"] == path


@pytest.mark.parametrize(
    ("word", "written"),
    [("/opt/x", "/opt/x"), ("/opt/a b", '"/opt/a b"'), ("/opt/50%", "/opt/50%%"), ('/a"b', '"/a\\"b"')],
)
def test_words_in_units(word: str, written: str) -> None:
    assert quoted(word) == written


def test_what_hides_this_python(monkeypatch: pytest.MonkeyPatch) -> None:
    assert outermost(["/home/a/b", "/home/a", "/home/ab", "/home/a"]) == ["/home/a", "/home/ab"]
    monkeypatch.setattr(program, "_HIDDEN", ())
    assert hidden_directories() == []
    monkeypatch.setattr(program, "_HIDDEN", (str(ROOT), "/no"))
    found = hidden_directories([str(ROOT / "shmmap"), str(ROOT), "", "/no/such/directory"])
    assert found == [str(ROOT)]


def test_the_daemon_s_command_starts_the_daemon() -> None:
    done = subprocess.run(
        f"exec {daemon_command()} --help",
        shell=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "usage: shmmap serve" in done.stdout


def test_printing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["unit", "print"]) == 0
    assert capsys.readouterr().out == unit_text("system/shmmapd.service")
    assert main(["unit", "print", "--user", "shmmapd.socket"]) == 0
    assert capsys.readouterr().out == shipped_text("user/shmmapd.socket")
    assert main(["unit", "print", "drop-ins/maps-in-home.conf"]) == 0
    assert "BindReadOnlyPaths=" in capsys.readouterr().out
    assert main(["unit", "print", "--list"]) == 0
    assert capsys.readouterr().out.splitlines() == shipped_names()
    assert main(["unit", "print", "../pyproject.toml"]) == 2
    with pytest.raises(BadRequest):
        shipped_text("/etc/passwd")


def test_a_dry_run_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["unit", "install", "--root", str(tmp_path), "--dry-run"]) == 0
    assert f"new  {tmp_path}/etc/shmmap/shmmap.toml" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
    assert main(["unit", "install", "--root", str(tmp_path), "--map", str(tmp_path / "none")]) == 66


def test_what_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "etc").write_text("in the way")
    assert main(["unit", "install", "--root", str(tmp_path)]) == 73


def test_planned_files_know_what_they_replace(tmp_path: Path) -> None:
    path = tmp_path / "file"
    assert PlannedFile(path, "a").action == "new"
    path.write_text("b")
    assert PlannedFile(path, "b").action == "same"
    assert PlannedFile(path, "a").action == "changed"
    assert PlannedFile(path, "a", keep=True).action == "kept"


def test_a_wheel_ships_them() -> None:
    """The wheel includes them where `shipped_directory` looks first (``.ci/run`` installs one and prints)."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    included = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included == {"systemd": "shmmap/_systemd"}
