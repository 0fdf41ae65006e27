# SPDX-License-Identifier: Apache-2.0
"""The unit files as systemd reads them: no complaint, no more rights than needed, templates in step."""

from __future__ import annotations

import configparser
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.live_relay import END_S
from shmmap.daemon.main import LIVE_ALONE_S
from shmmap.errors import (
    BadRequest,
    CannotStart,
    ConfigError,
    InstanceBusy,
    InternalError,
    MapDataError,
    MapMissing,
)
from shmmap.live_settings import SERVICE_STATE, live_directory
from tests.support.daemon_process import ROOT

UNITS = ROOT / "systemd"
USER = sorted(path.name for path in (UNITS / "user").iterdir())


def analyze(*words: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("there is no systemd-analyze")
    return subprocess.run(["systemd-analyze", *words], capture_output=True, text=True, check=False)


def copies(source: Path, to: Path) -> list[str]:
    """Copy units to where systemd-analyze reads them, with a program that exists; templates get a name."""
    found = []
    for path in sorted(source.iterdir()):
        text = re.sub("/usr/bin/shmmap(d|-ros-bridge| metrics)", "/bin/true", path.read_text())
        (to / path.name).write_text(text)
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


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("shmmapd.service", 0.8),
        ("shmmapd@.service", 0.8),
        ("shmmap-ros-bridge.service", 1.9),
        ("shmmap-metrics.service", 1.3),
    ],
)
def test_exposure_is_small(tmp_path: Path, name: str, most: float) -> None:
    """The bridge's is larger: it has to use the network."""
    copies(UNITS / "system", tmp_path)
    unit = str(tmp_path / name).replace("@.", "@car.")
    done = analyze("security", "--offline=true", "--no-pager", f"--threshold={most * 10:.0f}", unit)
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd-analyze judges no files")
    exposure = re.search(r"Overall exposure level for \S+: (\S+)", done.stdout)
    assert exposure is not None, done.stderr
    assert float(exposure[1]) <= most, done.stdout
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
        "StateDirectory=shmmap/state/%i",
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


SERVICES = [*(UNITS / "system").glob("shmmapd*.service"), *(UNITS / "user").glob("shmmapd.service")]
BRIDGES = [UNITS / manager / "shmmap-ros-bridge.service" for manager in ("system", "user")]


@pytest.mark.parametrize("path", [*SERVICES, *BRIDGES])
def test_what_cannot_get_better_is_not_started_again(path: Path) -> None:
    codes = {error.exit_code for error in (BadRequest, InstanceBusy, ConfigError)}
    prevented = parsed(path)["Service"]["RestartPreventExitStatus"]
    assert set(map(int, prevented.split())) == codes == {2, 75, 78}
    assert not codes & {error.exit_code for error in (CannotStart, MapMissing, MapDataError, InternalError)}


@pytest.mark.parametrize("path", SERVICES)
def test_what_can_get_better_is_tried_without_end_after_a_growing_pause(path: Path, tmp_path: Path) -> None:
    """On every version of systemd: by a line of the unit, which is run here."""
    unit = parsed(path)
    assert (unit["Unit"]["StartLimitIntervalSec"], unit["Service"]["Restart"]) == ("0", "on-failure")
    prefix, shell, option, script = shlex.split(unit["Service"]["ExecStopPost"].replace("/bin", " /bin", 1))
    assert (prefix.lstrip("-"), shell, option) == ("" if path.parent.name == "user" else "+", "/bin/sh", "-c")
    for name, text in (("systemctl", "echo $RESTARTS; echo $* >>asked"), ("sleep", "echo $1 >>slept")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)

    def pause(result: str, code: str, restarts: int) -> str:
        (tmp_path / "slept").write_text("")
        subprocess.run(
            [shell, option, script.replace("$$", "$").replace("%n", "one.service")],
            env={
                "PATH": f"{tmp_path}:/usr/bin:/bin",
                "SERVICE_RESULT": result,
                "EXIT_CODE": code,
                "RESTARTS": str(restarts),
            },
            cwd=tmp_path,
            check=True,
        )
        return (tmp_path / "slept").read_text()

    assert pause("success", "exited", 7) == ""
    assert [pause("exit-code", "exited", n) for n in (0, 1, 2, 9, 10, 11, 999)] == [
        f"{seconds}\n" for seconds in (0, 2, 4, 18, 20, 20, 20)
    ]
    assert [pause("watchdog", "killed", n) for n in (0, 1, 999)] == ["0\n", "2\n", "2\n"]
    user = "--user " if path.parent.name == "user" else ""
    assert set((tmp_path / "asked").read_text().splitlines()) == {
        f"{user}show --value -p NRestarts one.service"
    }
    stop_s = int(unit["Service"]["TimeoutStopSec"])
    assert stop_s > 20, "else systemd would cut the pause short"


@pytest.mark.parametrize("path", SERVICES)
def test_there_is_time_to_load_and_to_save_live_maps(path: Path) -> None:
    """The daemon gives up first, and says why."""
    service = parsed(path)["Service"]
    assert int(service["TimeoutStartSec"]) > LIVE_ALONE_S
    assert int(service["TimeoutStopSec"]) > END_S


@pytest.mark.parametrize("path", [*(UNITS / "system").glob("shmmapd*.service")], ids=lambda path: path.name)
def test_live_maps_have_a_place_of_their_own(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the maps that are served: systemd gives all of it to the service's account."""
    service = parsed(path)["Service"]
    instance = "%i" if "@" in path.name else "default"
    monkeypatch.setenv("STATE_DIRECTORY", f"/var/lib/{service['StateDirectory']}")
    assert live_directory(instance, "lidar") == f"/var/lib/shmmap/state/{instance}/live/lidar"
    assert f"{SERVICE_STATE}/{instance}" == f"/var/lib/{service['StateDirectory']}"
    assert service["StateDirectoryMode"] == "0750"
    tmpfiles = (UNITS / "tmpfiles.d" / "shmmap.conf").read_text()
    assert "/var/lib/shmmap/maps " in tmpfiles
    assert "/var/lib/shmmap/state" not in tmpfiles


@pytest.mark.parametrize("path", SERVICES)
def test_the_service_is_one_group_of_the_scheduler(path: Path) -> None:
    """In which the nice values of loaders count; the manager makes none for a weight that is not written."""
    assert parsed(path)["Service"]["CPUWeight"] == "100"


@pytest.mark.parametrize("path", [*(UNITS / "system").glob("*.socket"), *(UNITS / "user").glob("*.socket")])
def test_a_waiting_client_does_not_keep_starting_what_stays_down(path: Path) -> None:
    """Pauses between starts that may help make at most five starts in this time."""
    socket = parsed(path)["Socket"]
    assert (socket["TriggerLimitIntervalSec"], socket["TriggerLimitBurst"]) == ("10s", "5")


def test_every_file_says_its_licence() -> None:
    for path in UNITS.rglob("*"):
        if path.is_file() and path.suffix not in (".md", ".json"):  # which have no comments
            assert path.read_text().startswith("# SPDX-License-Identifier: Apache-2.0\n"), path
