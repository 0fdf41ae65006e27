# SPDX-License-Identifier: Apache-2.0
"""What `shmmap unit` writes and prints: into a directory of the test's own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from shmmap.cli.entry import main
from shmmap.errors import BadRequest, ConfigError, MapMissing
from shmmap.segment.names import HUGE_PAGES_DIR
from shmmap.service import program
from shmmap.service.file_system import FileSystem
from shmmap.service.huge_pages import check_possible
from shmmap.service.installation import (
    configuration,
    plan_system,
    plan_user,
    shipped_names,
    shipped_text,
    unit_text,
    write,
)
from shmmap.service.program import Program, command_line, outermost, quoted
from tests.support.daemon_process import ROOT
from tests.support.pages import read_page
from tests.unit.conftest import Verb

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def executable(path: Path, text: str = "") -> None:
    """Make a file that can be run."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """Return the root of an image's file system that has the program and a map."""
    root = tmp_path / "image"
    executable(root / "usr/bin/python3.11")
    executable(root / "usr/bin/kill")
    (root / "bin").symlink_to("usr/bin")
    (root / "usr/bin/python3").symlink_to("python3.11")
    for name in ("shmmap", "shmmapd", "shmmap-ros-bridge"):
        executable(root / "opt/shmmap/bin" / name, "#!/opt/shmmap/bin/python3\n")
    (root / "opt/shmmap/bin/python3").symlink_to("/usr/bin/python3")
    (root / "srv/map").mkdir(parents=True)
    return root


def paths_in(text: str) -> set[str]:
    """Every absolute path that a unit or a configuration names, but for what is made at start."""
    lines = [line for line in text.splitlines() if not line.startswith(("#", ";"))]
    found = {path for line in lines for path in re.findall(r'(?:^|[\s="\'])(/[^\s"\'$%:]+)', line)}
    return {path for path in found if not path.startswith(("/run", "/dev", "/proc", "/sys", "/var"))}


def test_an_image_names_nothing_outside_of_itself(
    image: Path, verb: Verb, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever Python writes it, and wherever the image lies on this machine; it may be named from here."""
    monkeypatch.chdir(image.parent)
    said = verb(["unit", "install", "--root", "image", "--map", "/srv/map"]).out
    assert "systemctl --root=image enable shmmapd" in said
    written = [path for path in (image / "etc").rglob("*") if path.is_file()]
    assert {str(path.relative_to(image)) for path in written} >= {
        "etc/systemd/system/shmmapd.service",
        "etc/systemd/system/shmmapd.socket",
        "etc/systemd/system/shmmapd@.service",
        "etc/systemd/system/shmmapd@.socket",
        "etc/systemd/system/shmmap-ros-bridge.service",
        "etc/systemd/system/shmmap-metrics.service",
        "etc/sysusers.d/shmmap.conf",
        "etc/tmpfiles.d/shmmap.conf",
        "etc/shmmap/shmmap.toml",
    }
    named = set[str]()
    for path in written:
        text = path.read_text()
        assert str(image) not in text
        assert sys.prefix not in text
        named |= paths_in(text)
    assert named >= {"/opt/shmmap/bin/shmmapd", "/opt/shmmap/bin/shmmap-ros-bridge", "/srv/map"}
    there = FileSystem(str(image))
    assert {path for path in named if there.status(path) is None} <= {"/usr/sbin/nologin", "/"}
    config = tomllib.loads((image / "etc/shmmap/shmmap.toml").read_text())
    assert config == {"map_path": "/srv/map", "group": "shmmap"}
    assert {one.action for one in plan_system("/srv/map", str(image))} == {"same", "kept"}
    assert sorted(path.name for path in (image / "etc").rglob(".*")) == []


def test_a_map_of_an_image(image: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may be named as there or as here; one that lies elsewhere is refused."""
    outside = tmp_path / "map"
    outside.mkdir()
    for given in ("/srv/map", str(image / "srv/map"), str(image / "srv/../srv/map")):
        config = plan_system(given, str(image))[-1].text
        assert tomllib.loads(config)["map_path"] == "/srv/map"
    (image / "maps").symlink_to("/srv")  # leads nowhere here
    assert tomllib.loads(plan_system("/maps/map", str(image))[-1].text)["map_path"] == "/maps/map"
    (image / "trap").symlink_to(outside)
    for given in (str(outside), "/trap", "/no", "/srv/map/../../../.." + str(outside)):
        with pytest.raises(MapMissing, match="below"):
            plan_system(given, str(image))
    drop_in = image / "etc/systemd/system/shmmapd.service.d/20-map.conf"
    for hidden in (True, False):
        monkeypatch.setattr(program, "_HIDDEN", ("/srv",) if hidden else ())
        write(plan_system("/srv/map", str(image)))
        assert ("\nBindReadOnlyPaths=/srv/map\n" in drop_in.read_text()) == hidden


def test_a_published_map_is_fetched_over_the_network(image: Path, verb: Verb) -> None:
    """With the credentials that are there; a map on this machine takes the network away again."""
    drop_in = image / "etc/systemd/system/shmmapd.service.d/25-published-map.conf"

    def install(where: str) -> set[str]:
        assert main(["unit", "install", "--root", str(image), "--map", where]) == 0
        return set(drop_in.read_text().splitlines()) if drop_in.exists() else set()

    assert install("/srv/map") == set()
    config = image / "etc/shmmap/shmmap.toml"
    config.unlink()
    for name in ("shmmap.aws", "shmmap.other"):
        (config.parent / name).touch()
    lines = install("s3://maps/town/")
    assert lines >= {"[Service]", "PrivateNetwork=no", "IPAddressDeny=", "After=network-online.target"}
    assert {line for line in lines if "Credential" in line} == {
        "LoadCredential=shmmap.aws:/etc/shmmap/shmmap.aws"
    }
    assert tomllib.loads(config.read_text())["map_path"] == "s3://maps/town"
    assert not [line for line in install("file:///srv/map") if not line.startswith("#")]
    said = verb(["unit", "install", "--root", str(image), "--map", "s3://key:secret@maps/town"], 2).err
    assert "secret" not in said.replace("may hold a secret", "")


def test_a_root_of_trust_is_copied_to_where_the_service_sees_it(
    image: Path, tmp_path: Path, verb: Verb, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may lie in a home directory, which the service does not see; it is public."""
    given = tmp_path / "home" / "ROOT.json"
    given.parent.mkdir(mode=0o700)
    content = b'{"signatures": [], "signed": {"_type": "root", "text": "\\u00e4 \xc3\xa4"}}\r\n'
    given.write_bytes(content)
    words = ["unit", "install", "--root", str(image), "--map", "s3://maps/town"]
    verb([*words, "--trust", str(given)])
    copy, config = image / "etc/shmmap/ROOT.json", image / "etc/shmmap/shmmap.toml"
    assert copy.read_bytes() == content
    assert copy.stat().st_mode & 0o777 == 0o644
    assert tomllib.loads(config.read_text())["trust"] == "/etc/shmmap/ROOT.json"
    monkeypatch.chdir(given.parent)
    given.write_bytes(content[:-2])
    assert "is kept: set map_path and trust there" in verb([*words, "--trust", "ROOT.json"]).out
    assert copy.read_bytes() == content[:-2]
    assert main(words) == 0
    assert copy.read_bytes() == content[:-2], "an installation without it leaves it there"
    given.write_text("{}")
    assert "no root of trust" in verb([*words, "--trust", str(given)], 78).err
    assert main(["unit", "install", "--root", str(image), "--trust", str(given)]) == 2
    given.write_bytes(content)
    user = {one.path.name: one.text for one in plan_user("s3://maps/town", str(tmp_path), trust=str(given))}
    assert user["ROOT.json"].encode() == content
    assert tomllib.loads(user["shmmap.toml"])["trust"] == str(tmp_path / "shmmap/ROOT.json")


def test_links_do_not_lead_out_of_an_image(image: Path, tmp_path: Path) -> None:
    """An absolute link starts at the image's root, and `..` ends there; what is linked to is not written."""
    elsewhere = tmp_path / "etc"
    elsewhere.mkdir()
    (image / "private/etc").mkdir(parents=True)
    (image / "etc").symlink_to("/private/etc")
    (image / "private/etc/systemd").symlink_to("../../../../../usr/lib/systemd")
    (image / "private/etc/sysusers.d").symlink_to(elsewhere)
    kept = elsewhere / "shmmap.conf"
    kept.write_text("of this machine")
    write(plan_system("/srv/map", str(image)))
    assert (image / "usr/lib/systemd/system/shmmapd.service").is_file()
    assert (image / "private/etc/shmmap/shmmap.toml").is_file()
    assert (image / str(elsewhere).lstrip("/") / "shmmap.conf").is_file()
    assert kept.read_text() == "of this machine"
    assert list(elsewhere.iterdir()) == [kept]
    (image / "private/etc/tmpfiles.d").mkdir(exist_ok=True)
    (image / "private/etc/shmmap").rename(image / "private/etc/away")
    (image / "private/etc/shmmap").symlink_to("shmmap")
    assert main(["unit", "install", "--root", str(image)]) == 73


@pytest.mark.parametrize("what", ["link", "pipe", "latin-1", "large", "directory"])
def test_whatever_lies_where_a_unit_goes(image: Path, tmp_path: Path, what: str) -> None:
    unit = image / "etc/systemd/system/shmmapd.service"
    unit.parent.mkdir(parents=True)
    other = tmp_path / "other"
    if what == "link":
        other.write_text("stays")
        unit.symlink_to(other)
    elif what == "pipe":
        os.mkfifo(unit)
    elif what == "directory":
        unit.mkdir()
    else:
        unit.write_bytes("Beschreibung=Straße".encode("latin-1") if what == "latin-1" else b"x" * (1 << 24))
    assert main(["unit", "install", "--root", str(image)]) == (73 if what == "directory" else 0)
    if what != "directory":
        assert unit.read_text() == unit_text(
            "system/shmmapd.service", Program.in_image(FileSystem(str(image)))
        )
    if what == "link":
        assert other.read_text() == "stays"
    assert not list(unit.parent.glob(".*"))


@pytest.mark.parametrize("root", ["", "no/such/directory", "file"])
def test_a_root_that_is_none(root: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: Verb) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert "no directory" in verb(["unit", "install", "--root", root], 2).err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_program_that_would_not_start_in_the_image(image: Path, tmp_path: Path, verb: Verb) -> None:
    """It was made from outside, its Python is not there, others cannot read it, or there is none."""
    script = image / "opt/shmmap/bin/shmmapd"
    words = ["unit", "install", "--root", str(image)]
    executable(script, f"#!{image}/opt/shmmap/bin/python3\n")
    assert f"run by {image}/opt/shmmap/bin/python3" in verb(words, 78).err
    executable(script, "#!/opt/shmmap/bin/python3\n")
    (image / "usr/bin/python3.11").unlink()
    assert "chroot IMAGE sh -c 'python3 -m venv /opt/shmmap" in verb(words, 78).err
    executable(image / "usr/bin/python3.11")
    (image / "opt/shmmap").chmod(0o700)
    assert "only its owner may read /opt/shmmap" in verb(words, 78).err
    (image / "opt/shmmap").chmod(0o755)
    script.unlink()
    assert "no shmmap is installed below" in verb(words, 78).err
    executable(image / "usr/bin/shmmapd", "#!/usr/bin/python3\n")
    assert main(words) == 0
    unit = (image / "etc/systemd/system/shmmapd.service").read_text()
    assert "\nExecStart=/usr/bin/shmmapd --config" in unit
    bridge = (image / "etc/systemd/system/shmmap-ros-bridge.service").read_text()
    assert "\nExecStart=/usr/bin/python3 -m shmmap_clients.ros_bridge " in bridge


def test_a_python_that_the_units_would_hide_is_shown(image: Path) -> None:
    python = image / "home/robot/.pyenv/versions/3.12/bin/python3"
    executable(python)
    (image / "opt/shmmap/bin/python3").unlink()
    (image / "opt/shmmap/bin/python3").symlink_to("/home/robot/.pyenv/versions/3.12/bin/python3")
    write(plan_system("", str(image)))
    drop_in = image / "etc/systemd/system/shmmapd.service.d/10-program.conf"
    assert "\nBindReadOnlyPaths=/home/robot/.pyenv/versions/3.12\n" in drop_in.read_text()


def test_units_are_replaced_and_the_configuration_is_kept(image: Path) -> None:
    write(plan_system(root=str(image)))
    unit = image / "etc/systemd/system/shmmapd.service"
    config = image / "etc/shmmap/shmmap.toml"
    unit.write_text("old")
    config.write_text("mine")
    actions = {one.path: one.action for one in plan_system(root=str(image))}
    assert (actions[unit], actions[config]) == ("changed", "kept")
    write(plan_system(root=str(image)))
    assert unit.read_text() == unit_text("system/shmmapd.service", Program.in_image(FileSystem(str(image))))
    assert config.read_text() == "mine"


def test_huge_pages(image: Path, verb: Verb) -> None:
    assert not any("huge" in one.path.name for one in plan_system(root=str(image)))
    assert "systemctl stop" not in verb(["unit", "install", "--root", str(image), "--huge-pages"]).out
    units = image / "etc/systemd/system"
    mount = (units / "run-shmmap_huge.mount").read_text()
    assert f"\nWhere={HUGE_PAGES_DIR}\n" in mount
    assert "\nOptions=huge=within_size,size=50%%," in mount
    for service in ("shmmapd.service", "shmmapd@.service"):
        drop_in = (units / f"{service}.d" / "30-huge-pages.conf").read_text()
        for line in ("RequiresMountsFor=", "ReadWritePaths=", "Environment=SHMMAP_SHM_DIR="):
            assert f"\n{line}{HUGE_PAGES_DIR}\n" in drop_in
    assert sum("huge" in one.path.name for one in plan_system(root=str(image))) == 3, "an upgrade keeps them"
    refused = verb(["unit", "install", "--user", "--huge-pages", "--dry-run"], 2).err
    assert "mount -o remount,huge=within_size /dev/shm" in refused


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
        "systemd/user/shmmap-metrics.service",
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
    assert Program.this_one().hidden_directories == []
    monkeypatch.setattr(program, "_HIDDEN", (str(ROOT), "/no"))
    monkeypatch.setattr(sys, "path", [str(ROOT / "shmmap"), str(ROOT), "", "/no/such/directory"])
    monkeypatch.setattr(sys, "prefix", "/usr")
    assert Program.this_one().hidden_directories == [str(ROOT)]


def test_a_program_that_the_service_cannot_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "venv"
    place.mkdir()
    monkeypatch.setattr(sys, "prefix", str(place))
    opened_above(tmp_path)
    place.chmod(0o700)
    with pytest.raises(ConfigError, match=f"only its owner may read {place} ") as refused:
        Program.this_one().check_readable()
    assert "python3 -m venv /opt/shmmap && /opt/shmmap/bin/pip install ." in refused.value.hint
    # a user's own service runs as that user
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    assert main(["unit", "install", "--user", "--dry-run"]) == 0


def opened_above(path: Path) -> None:
    """Let others enter the directories of a test."""
    for above in (path, *path.parents):
        if above == Path(tempfile.gettempdir()):
            break
        above.chmod(0o755)


@pytest.mark.parametrize("shown", [True, False])
def test_what_lies_above_does_not_matter_where_the_units_show_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: bool
) -> None:
    home = tmp_path / "home"
    (home / "venv").mkdir(parents=True)
    opened_above(tmp_path)
    home.chmod(0o700)
    monkeypatch.setattr(program, "_HIDDEN", (str(home),) if shown else ())
    one = Program(("x",), ("x",), (str(home / "venv"),), (str(home / "venv"),))
    if shown:
        one.check_readable()
    else:
        with pytest.raises(ConfigError, match=str(home)):
            one.check_readable()


@pytest.mark.parametrize(("which", "name"), [("daemon", "shmmap serve"), ("bridge", "shmmap-ros-bridge")])
def test_a_command_starts_its_program(which: str, name: str) -> None:
    done = subprocess.run(
        f"exec {command_line(getattr(Program.this_one(), which))} --help",
        shell=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "clients")])},
        capture_output=True,
        text=True,
        check=True,
    )
    assert f"usage: {name}" in done.stdout


def test_printing(verb: Verb) -> None:
    assert verb(["unit", "print"]).out == unit_text("system/shmmapd.service")
    assert verb(["unit", "print", "--user", "shmmapd.socket"]).out == shipped_text("user/shmmapd.socket")
    assert "BindReadOnlyPaths=" in verb(["unit", "print", "drop-ins/maps-in-home.conf"]).out
    assert verb(["unit", "print", "--list"]).out.splitlines() == shipped_names()
    assert main(["unit", "print", "../pyproject.toml"]) == 2
    with pytest.raises(BadRequest):
        shipped_text("/etc/passwd")


def test_a_dry_run_writes_nothing(image: Path, verb: Verb) -> None:
    said = verb(["unit", "install", "--root", str(image), "--dry-run"]).out
    assert f"new  {image}/etc/shmmap/shmmap.toml" in said
    assert not (image / "etc").exists()
    assert main(["unit", "install", "--root", str(image), "--map", str(image / "none")]) == 66


def test_a_wheel_ships_them() -> None:
    """The wheel includes them where `shipped_directory` looks first (``.ci/run`` installs one and prints)."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    included = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included["systemd"] == "shmmap/_systemd"


def test_the_operators_guide_names_each_shipped_file() -> None:
    guide = read_page("systemd/README.md").text
    named = set(re.findall(r"`((?:system|user|drop-ins|prometheus|sysusers\.d|tmpfiles\.d)/[^`/ ]+)`", guide))
    named |= {"shmmap.toml"} if "`shmmap.toml`" in guide else set()
    containers = read_page("shmmap/CONTAINERS.md").text
    named |= set(re.findall(r"systemd/(container/[\w.]+)", containers)) | {
        "container/Dockerfile.dockerignore"
    }
    assert named == set(shipped_names()) - {"README.md"}
