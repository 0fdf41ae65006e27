# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap-ros-bridge`` takes and refuses before it asks a daemon; the rest is in ``tests/process``."""

from __future__ import annotations

import subprocess
import sys

import pytest
from shmmap_clients.ros_bridge.cli import main


@pytest.mark.parametrize(
    "more",
    [
        ["--domain", "233"],
        ["--domain", "-1"],
        ["--domain", "x"],
        ["--name", "partial"],
        ["--name", "nothing=/x"],
        ["--name", "partial="],
        ["--wait", "-1"],
        ["--whole-map-limit", "0"],
        ["--voxels-every", "0"],
    ],
)
def test_impossible_values_exit_2(capsys: pytest.CaptureFixture[str], more: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*more, "--endpoint", "/nowhere/none.sock"])
    assert ended.value.code == 2
    assert f"argument {more[0]}: expected " in capsys.readouterr().err


def test_without_a_daemon_it_says_so(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("cyclonedds", reason="needs the package cyclonedds")
    assert main(["--endpoint", "/nowhere/none.sock"]) == 69
    assert "none.sock" in capsys.readouterr().err
    monkeypatch.setenv("ROS_DOMAIN_ID", "lidar")
    assert main(["--endpoint", "/nowhere/none.sock"]) == 78
    assert "'lidar'" in capsys.readouterr().err


def test_without_cyclonedds_it_says_what_to_install() -> None:
    code = (
        "import sys\nsys.modules['cyclonedds'] = None\nfrom shmmap_clients.ros_bridge.cli import main\n"
        "sys.exit(main([]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 69
    assert "needs the package cyclonedds" in done.stderr
    assert "pip install cyclonedds" in done.stderr
