# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt device-check``: equal devices pass, others do not; numpy and pyopencl are all it needs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher.backends import opencl_backend
from shmmap_clients.ndt_scan_matcher.cli import device_check, main
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance

from shmmap.layers import voxel_covariances
from tests.support.opencl_device import need_device

BARE = """
import sys

class OnlyThese:
    # what numpy and pyopencl bring, the standard library, and this project
    allowed = {"numpy", "pyopencl", "pytools", "platformdirs", "siphash24", "typing_extensions", "shmmap",
               "shmmap_clients", "mako", "cython_runtime"}

    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in self.allowed and top not in sys.stdlib_module_names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, OnlyThese())
from shmmap_clients.ndt_scan_matcher.cli import device_check, main
device_check.SCENES = device_check.SCENES[2:3]
device_check._TIMED, device_check._TIMED_BATCHES = 20, 2  # how long they take is not looked at
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize(("origin", "leaf", "points"), device_check.SCENES)
def test_a_scene_is_aligned_by_numpy(origin: tuple[float, float], leaf: float, points: int) -> None:
    scene = device_check._scene(origin, leaf, min(points, 1500))
    assert len(scene.scan) == 1500
    assert scene.voxel_map.voxels > 900
    assert len(scene.wanted) == 10
    off = {
        settings: np.linalg.norm(result.T_map_base[:3, 3] - scene.guess[:3] + device_check._OFF[:3])
        for settings, result in scene.wanted
    }
    assert min(off.values()) < 0.03
    assert np.median(list(off.values())) < 0.3


def test_the_gaussians_are_those_of_the_layer() -> None:
    voxel_map = device_check._voxels(device_check._street(np.random.default_rng(1)), 2.0)
    for key, cell in voxel_map.cells.items():
        assert (cell.lattice >= 0).sum() == len(cell.count)
        for kind in get_args(Covariance):
            wanted = voxel_covariances(cell.count, cell.scatter, kind)[1]
            np.testing.assert_allclose(voxel_map.inverses(key, kind), wanted, rtol=1e-6, atol=1e-6)


def test_a_device_that_is_equal_passes_with_numpy_and_pyopencl_alone(tmp_path: Path) -> None:
    need_device()
    report = tmp_path / "report.json"
    done = subprocess.run(
        [sys.executable, "-c", BARE, "device-check", "--json", str(report)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    document = json.loads(report.read_text())
    assert document["equal"] is True
    assert {entry["precision"] for entry in document["devices"]} == {"double", "float"}
    for entry in document["devices"]:
        assert entry["error"] is None
        assert len(entry["checks"]) == 4
        for check in entry["checks"]:
            assert check["equal"] is True, check
        (times,) = entry["latencies"].values()
        assert times["points"] == 1500
        assert 0 < times["evaluation_ms"]["min"] <= times["evaluation_ms"]["p99"]
    double = next(entry for entry in document["devices"] if entry["precision"] == "double")
    assert max(check["worst"].get("t_m", 0.0) for check in double["checks"]) <= 1e-9


def test_what_is_not_equal_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    need_device()
    source = opencl_backend.kernel_source()
    term = "s[37] = ux * l02 + uy * l12 + uz * l22;"
    assert source.count(term) == 1
    wrong = source.replace(term, term.replace("+ uz", "- uz"))
    monkeypatch.setattr(opencl_backend, "kernel_source", lambda: wrong)
    monkeypatch.setattr(device_check, "SCENES", device_check.SCENES[:1])
    monkeypatch.setattr(device_check, "_TIMED", 20)
    monkeypatch.setattr(device_check, "_TIMED_BATCHES", 2)
    report = tmp_path / "out.json"
    assert main(["device-check", "--json", str(report)]) == 1
    assert "UNEQUAL: evaluations" in capsys.readouterr().out
    document = json.loads(report.read_text())
    assert document["equal"] is False
    failed = [
        check["what"] for entry in document["devices"] for check in entry["checks"] if check["failures"]
    ]
    assert any(what.startswith("evaluations") for what in failed)
    assert not any(what.startswith("repeats") for what in failed)


def test_a_gpu_that_is_not_there_is_exit_code_3(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from shmmap_clients.ndt_scan_matcher.backends.opencl import devices

    need_device()
    processors = [one for one in devices._found() if one[0].kind != "GPU"]
    monkeypatch.setattr(devices, "_found", lambda: processors)
    assert main(["device-check", "--require", "gpu"]) == 3
    assert "no such OpenCL GPU" in capsys.readouterr().err
    assert main(["device-check", "--device", "no such name"]) == 3


def test_the_help_does_not_list_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    said = capsys.readouterr().out
    assert "devices" in said
    assert "device-check" not in said
