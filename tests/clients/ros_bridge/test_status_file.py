# SPDX-License-Identifier: Apache-2.0
"""A bridge's status: the file, and what `shmmap doctor` makes of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from shmmap_clients.ros_bridge.status_file import StatusFile, status_name

import shmmap
from shmmap.daemon.config import load_config
from shmmap.doctor.access import check_ros_bridge
from shmmap.doctor.checks import examine
from shmmap.doctor.verdicts import Finding

HOLDER = """\
import json, sys
from shmmap_clients.ros_bridge.status_file import StatusFile
file = StatusFile(sys.argv[1], "town", int(sys.argv[2]))
file.write(json.loads(sys.argv[3]))
print(file.path, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "own"))
    (tmp_path / "own" / "shmmap").mkdir(parents=True)
    return str(tmp_path / "town.sock")


def finding(socket: str, tmp_path: Path) -> Finding:
    flags = {"instance": "town", "endpoint": socket, "shm_dir": str(tmp_path)}
    return check_ros_bridge(examine(load_config(flags), ""))


def bridge(socket: str, domain: int, status: object) -> subprocess.Popen[str]:
    """Another process with the file: the holder of a lock does not see it itself."""
    pipe = subprocess.PIPE
    words = [sys.executable, "-c", HOLDER, socket, str(domain), json.dumps(status)]
    made = subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True)
    assert made.stdout is not None
    assert made.stdout.readline().strip().endswith(status_name("town", domain))
    return made


def test_doctor_names_incompatible_peers_of_running_bridges(socket: str, tmp_path: Path) -> None:
    assert finding(socket, tmp_path).skipped
    fast = {"service": "/map/get_partial_pointcloud_map", "vendor": "Fast DDS"}
    status = {"domain": 3, "clients": 5, "incompatible": [fast, fast, {"service": "/x", "vendor": ""}]}
    with bridge(socket, 0, {"domain": 0, "clients": 1, "incompatible": []}) as first:
        found = finding(socket, tmp_path)
        assert (found.state, found.fact) == ("ok", "domain 0: 1 client")
        with bridge(socket, 3, status) as second:
            found = finding(socket, tmp_path)
            assert found.state == "warn"
            assert "2 clients of /map/get_partial_pointcloud_map, of Fast DDS; 1 client of /x" in found.fact
            assert "rmw_cyclonedds_cpp" in found.advice
            second.kill()
        assert Path(tmp_path, status_name("town", 3)).exists(), "it was killed"
        assert finding(socket, tmp_path).state == "ok"
        first.kill()
    assert finding(socket, tmp_path).skipped


@pytest.mark.parametrize(
    "status", ["", "[]", "{", '{"domain": 1}', '{"domain": "x", "clients": 1, "incompatible": []}', "\0"]
)
def test_doctor_survives_what_is_no_bridge_s_file(socket: str, tmp_path: Path, status: str) -> None:
    with bridge(socket, 1, {"domain": 1, "clients": 0, "incompatible": []}) as one:
        Path(tmp_path, status_name("town", 1)).write_text(status)
        assert finding(socket, tmp_path).skipped
        one.kill()


def test_one_bridge_for_a_domain(socket: str) -> None:
    with bridge(socket, 0, {}) as one:
        with pytest.raises(shmmap.errors.Busy, match="another bridge of this daemon"):
            StatusFile(socket, "town", 0)
        other = StatusFile(socket, "town", 1)
        other.close()
        one.kill()
    after = StatusFile(socket, "town", 0)
    after.write({"a": "x" * 100})
    after.write({"b": 1})
    assert json.loads(Path(after.path).read_text()) == {"b": 1}, "what was longer leaves nothing"
    after.close()
    assert not os.path.exists(after.path)


def test_the_user_s_own_directory_where_the_daemon_s_is_not_writable(socket: str, tmp_path: Path) -> None:
    """There is no such directory here: to root, every directory is writable."""
    file = StatusFile(str(tmp_path / "missing" / "town.sock"), "town", 0)
    assert file.path == str(tmp_path / "own" / "shmmap" / status_name("town", 0))
    file.close()
    os.rmdir(tmp_path / "own" / "shmmap")
    nowhere = StatusFile(str(tmp_path / "missing" / "town.sock"), "town", 0)
    nowhere.write({})
    nowhere.close()
    assert nowhere.path == ""


def test_a_link_is_not_followed(socket: str, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("kept")
    (tmp_path / status_name("town", 0)).symlink_to(victim)
    file = StatusFile(socket, "town", 0)
    file.write({"a": 1})
    assert victim.read_text() == "kept"
    assert file.path.startswith(str(tmp_path / "own"))
    file.close()
