# SPDX-License-Identifier: Apache-2.0
"""What `shmmap unit` writes and prints: into a directory of the test's own."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from shmmap.cli.entry import main
from shmmap.errors import BadRequest, ConfigError, MapMissing
from shmmap.segment.names import HUGE_PAGES_DIR
from shmmap.service import installation, program
from shmmap.service.huge_pages import check_possible
from shmmap.service.installation import PlannedFile, configuration, plan_system, plan_user, unit_text, write
from shmmap.service.program import bridge_command, daemon_command, hidden_directories, outermost, quoted
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
        "etc/systemd/system/shmmap-ros-bridge.service",
        "etc/sysusers.d/shmmap.conf",
        "etc/tmpfiles.d/shmmap.conf",
        "etc/shmmap/shmmap.toml",
    }
    assert {one.action for one in planned} == {"new"}
    write(planned)
    assert {one.action for one in plan_system(root=str(tmp_path))} == {"same", "kept"}
    unit = (tmp_path / "etc/systemd/system/shmmapd.service").read_text()
    assert f"\nExecStart={daemon_command()} --config %E/shmmap/shmmap.toml\n" in unit
    bridge = (tmp_path / "etc/systemd/system/shmmap-ros-bridge.service").read_text()
    assert f"\nExecStart={bridge_command()} $ROS_BRIDGE_OPTIONS\n" in bridge
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


def test_huge_pages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert not any("huge" in one.path.name for one in plan_system(root=str(tmp_path)))
    assert main(["unit", "install", "--root", str(tmp_path), "--huge-pages"]) == 0
    units = tmp_path / "etc/systemd/system"
    mount = (units / "run-shmmap_huge.mount").read_text()
    assert f"\nWhere={HUGE_PAGES_DIR}\n" in mount
    assert "\nOptions=huge=within_size,size=50%%," in mount
    for service in ("shmmapd.service", "shmmapd@.service"):
        drop_in = (units / f"{service}.d" / "30-huge-pages.conf").read_text()
        for line in ("RequiresMountsFor=", "ReadWritePaths=", "Environment=SHMMAP_SHM_DIR="):
            assert f"\n{line}{HUGE_PAGES_DIR}\n" in drop_in
    assert sum("huge" in one.path.name for one in plan_system(root=str(tmp_path))) == 3, (
        "an upgrade keeps them"
    )
    assert "systemctl stop" not in capsys.readouterr().out
    assert main(["unit", "install", "--user", "--huge-pages", "--dry-run"]) == 2
    assert "mount -o remount,huge=within_size /dev/shm" in capsys.readouterr().err


@pytest.mark.parametrize("switch", ["always within_size advise never [deny] force", ""])
def test_huge_pages_that_the_kernel_lacks(tmp_path: Path, switch: str) -> None:
    path = tmp_path / "shmem_enabled"
    if switch:
        path.write_text(switch)
    with pytest.raises(ConfigError, match="no huge pages"):
        check_possible(user=False, switch=str(path))
    path.write_text("always within_size advise [never] deny force")
    check_possible(user=False, switch=str(path))


def test_a_user_s_service(tmp_path: Path) -> None:
    planned = plan_user(str(tmp_path), str(tmp_path / "config"))
    write(planned)
    assert sorted(str(one.path.relative_to(tmp_path / "config")) for one in planned) == [
        "shmmap/shmmap.toml",
        "systemd/user/shmmap-ros-bridge.service",
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


def test_a_program_that_the_service_cannot_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "venv"
    place.mkdir()
    monkeypatch.setattr(sys, "prefix", str(place))
    tmp_path.chmod(0o755)
    place.chmod(0o700)
    words = ["unit", "install", "--root", str(tmp_path / "image")]
    assert main(words) == 78
    said = capsys.readouterr().err
    assert f"only its owner may read {place}\n" in said
    assert "python3 -m venv /opt/shmmap && /opt/shmmap/bin/pip install ." in said
    assert not (tmp_path / "image").exists()
    place.chmod(0o755)
    assert main(words) == 0
    # a user's own service runs as that user
    place.chmod(0o700)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    assert main(["unit", "install", "--user", "--dry-run"]) == 0


@pytest.mark.parametrize("shown", [True, False])
def test_what_lies_above_does_not_matter_where_the_units_show_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: bool
) -> None:
    home = tmp_path / "home"
    (home / "venv").mkdir(parents=True)
    home.chmod(0o700)
    monkeypatch.setattr(sys, "prefix", str(home / "venv"))
    others = [place for place in hidden_directories() if not place.startswith(str(tmp_path))]
    monkeypatch.setattr(program, "hidden_directories", lambda: others + [str(home / "venv")] * shown)
    for above in (tmp_path, *tmp_path.parents):
        if above == Path(tempfile.gettempdir()):
            break
        above.chmod(0o755)
    if shown:
        program.check_readable()
    else:
        with pytest.raises(ConfigError, match=str(home)):
            program.check_readable()


def test_in_an_image_the_program_is_where_the_image_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "image" / "opt" / "shmmap" / "bin" / "shmmapd"
    script.parent.mkdir(parents=True)
    script.write_text("#!/bin/sh\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "prefix", str(script.parent.parent))
    monkeypatch.setattr(installation, "check_readable", lambda: None)
    write(plan_system(root=str(tmp_path / "image")))
    units = tmp_path / "image" / "etc" / "systemd" / "system"
    for name in ("shmmapd.service", "shmmapd@.service"):
        assert "\nExecStart=/opt/shmmap/bin/shmmapd " in (units / name).read_text()
    assert daemon_command() == str(script)
    assert daemon_command(str(tmp_path / "ima")) == str(script)


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


def test_the_bridge_s_command_starts_the_bridge() -> None:
    paths = os.pathsep.join([str(ROOT), str(ROOT / "clients")])
    done = subprocess.run(
        f"exec {bridge_command()} --help",
        shell=True,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "usage: shmmap-ros-bridge" in done.stdout


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
    assert included["systemd"] == "shmmap/_systemd"
