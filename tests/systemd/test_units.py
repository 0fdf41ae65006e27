# SPDX-License-Identifier: Apache-2.0
"""The unit files as systemd reads them: no complaint, no more rights than needed, templates in step."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from shmmap.daemon.config import DaemonConfig
from shmmap.errors import BadRequest, ConfigError, InstanceBusy, MapMissing
from tests.support.daemon_process import ROOT

UNITS = ROOT / "systemd"
SYSTEM = sorted(path.name for path in (UNITS / "system").iterdir())
USER = sorted(path.name for path in (UNITS / "user").iterdir())


def analyze(*words: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("there is no systemd-analyze")
    return subprocess.run(["systemd-analyze", *words], capture_output=True, text=True, check=False)


def copies(source: Path, to: Path) -> list[str]:
    """Copy units to where systemd-analyze reads them, with a program that exists; templates get a name."""
    found = []
    for path in sorted(source.iterdir()):
        (to / path.name).write_text(path.read_text().replace("/usr/bin/shmmapd", "/bin/true"))
        found.append(str(to / path.name.replace("@.", "@car.")))
    return found


@pytest.mark.parametrize("manager", ["system", "user"])
def test_systemd_has_nothing_to_say_about_them(
    tmp_path: Path, manager: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    done = analyze("verify", f"--{manager}", "--man=no", *copies(UNITS / manager, tmp_path))
    assert (done.stdout, done.stderr, done.returncode) == ("", "", 0)  # unknown keys are only printed


def test_a_mistake_would_be_noticed(tmp_path: Path) -> None:
    copies(UNITS / "system", tmp_path)
    unit = tmp_path / "shmmapd.service"
    unit.write_text(unit.read_text().replace("WatchdogSec=", "WatchDog="))
    assert "Unknown key" in analyze("verify", "--man=no", str(unit)).stderr


@pytest.mark.parametrize("name", ["shmmapd.service", "shmmapd@.service"])
def test_exposure_is_at_most_0_8(tmp_path: Path, name: str) -> None:
    copies(UNITS / "system", tmp_path)
    unit = str(tmp_path / name).replace("@.", "@car.")
    done = analyze("security", "--offline=true", "--no-pager", "--threshold=8", unit)
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd-analyze judges no files")
    exposure = re.search(r"Overall exposure level for \S+: (\S+)", done.stdout)
    assert exposure is not None, done.stderr
    assert float(exposure[1]) <= 0.8, done.stdout
    assert done.returncode == 0


def settings(path: Path) -> list[str]:
    """The lines that are no comments."""
    return [line for line in path.read_text().splitlines() if line and not line.startswith("#")]


def changed(one: Path, other: Path) -> list[tuple[str, str]]:
    """Lines in which two units of equal length differ."""
    pairs = zip(settings(one), settings(other), strict=True)
    return [(a, b) for a, b in pairs if a != b]


def test_templates_differ_only_by_their_instance() -> None:
    assert [b for _, b in changed(*(UNITS / "system" / f"shmmapd{at}.service" for at in ("", "@")))] == [
        "Description=Point-cloud map %i in shared memory",
        "ExecStart=/usr/bin/shmmapd --instance %i --config %E/shmmap/%i.toml",
    ]
    assert [b for _, b in changed(*(UNITS / "system" / f"shmmapd{at}.socket" for at in ("", "@")))] == [
        "Description=Requests for the point-cloud map %i in shared memory",
        "ListenStream=/run/shmmap/%i.sock",
    ]


def parsed(path: Path) -> configparser.ConfigParser:
    parser = configparser.ConfigParser(strict=False, interpolation=None, comment_prefixes=("#",))
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(path)
    return parser


def test_the_socket_is_where_clients_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/shmmap")
    listens = parsed(UNITS / "system" / "shmmapd.socket")["Socket"]["ListenStream"]
    assert listens == DaemonConfig().socket()
    service = parsed(UNITS / "system" / "shmmapd.service")["Service"]
    assert f"/run/{service['RuntimeDirectory']}/default.sock" == listens
    monkeypatch.setenv("RUNTIME_DIRECTORY", "%t/shmmap")
    own = parsed(UNITS / "user" / "shmmapd.socket")["Socket"]["ListenStream"]
    assert DaemonConfig().socket().endswith(own)


@pytest.mark.parametrize("path", [*(UNITS / "system").glob("*.service"), *(UNITS / "user").glob("*.service")])
def test_what_cannot_get_better_is_not_started_again(path: Path) -> None:
    codes = {error.exit_code for error in (BadRequest, MapMissing, InstanceBusy, ConfigError)}
    prevented = parsed(path)["Service"]["RestartPreventExitStatus"]
    assert set(map(int, prevented.split())) == codes == {2, 66, 75, 78}


def test_every_file_says_its_licence() -> None:
    for path in UNITS.rglob("*"):
        if path.is_file() and path.suffix != ".md":
            assert path.read_text().startswith("# SPDX-License-Identifier: Apache-2.0\n"), path
