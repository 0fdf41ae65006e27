# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt device-check``: equal devices pass, others do not; numpy and pyopencl are all it needs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.demo.town_scene import town_scene
from shmmap_clients.ndt_scan_matcher.backends.opencl import program
from shmmap_clients.ndt_scan_matcher.cli import main
from shmmap_clients.ndt_scan_matcher.device_check.scenes import (
    Case,
    Scene,
    load_scenes,
    pack_scenes,
    reference_scenes,
    town_scenes,
)

import shmmap
from tests.clients.ndt_scan_matcher.scene import map_of, scan_from, street
from tests.support.opencl_device import need_device

TRUTH = np.array([1.3, 0.4, 1.8, 0.02, -0.03, 0.4])
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
from shmmap_clients.ndt_scan_matcher.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One small scene with one case of each kind, and what an original program might have given."""
    points = street()
    guess = tuple((TRUTH + np.array([0.2, -0.15, 0.1, 0.01, 0.02, -0.03])).tolist())
    expected = {"iterations": 999, "T": np.eye(4)[:3].tolist(), "transform_probability": 0.0}
    cases = (
        Case("plain", "autoware", "radius", guess),
        Case("fine", "autoware", "radius", guess, mode="coarse_fine"),
        Case("search", "pclomp", "direct7", guess, epsilon=0.05, max_iterations=20, step_size=0.2),
    )
    path = tmp_path_factory.mktemp("packed") / "scenes.npz"
    scene = Scene("street", map_of(points, 2.0), scan_from(points, TRUTH, 400).astype(np.float32), cases)
    pack_scenes([scene], path)
    wrong = Scene(
        "wrong", scene.voxel_map, scene.scan, (Case("plain", "autoware", "radius", guess, expected=expected),)
    )
    pack_scenes([wrong], path.with_name("wrong.npz"))
    return path


def test_scenes_come_back_from_their_file(packed: Path) -> None:
    (scene,) = load_scenes(packed)
    assert scene.name == "street"
    assert [case.name for case in scene.cases] == ["plain", "fine", "search"]
    fresh = map_of(street(), 2.0)
    assert list(scene.voxel_map.cells) == list(fresh.cells)
    for key, cell in fresh.cells.items():
        np.testing.assert_array_equal(scene.voxel_map.cells[key].mean, cell.mean)
        np.testing.assert_array_equal(scene.voxel_map.cells[key].lattice, cell.lattice)
        for covariance in ("autoware", "pclomp", "pcl"):
            np.testing.assert_array_equal(
                scene.voxel_map.inverses(key, covariance),
                fresh.inverses(key, covariance),
            )
    with pytest.raises(shmmap.MapMissing):
        load_scenes(packed.with_name("none.npz"))
    np.savez(packed.with_name("other.npz"), xyz=np.zeros((3, 3)))
    with pytest.raises(shmmap.BadRequest, match="--pack"):
        load_scenes(packed.with_name("other.npz"))


def test_the_town_is_a_scene_at_the_origin_and_far_away() -> None:
    cloud, scans = town_scene(scans=2)
    assert len(scans) == 2
    assert len(cloud) > 100_000
    scenes = town_scenes()
    assert {len(scene.scan) for scene in scenes} == {1500, 15_950}
    assert sum("far" in scene.name for scene in scenes) == len(scenes) // 2
    assert all(scene.voxel_map.voxels > 1000 and len(scene.cases) == 10 for scene in scenes)


def test_references_are_scenes(data_dir: Path) -> None:
    scenes = reference_scenes(data_dir / "ndt")
    assert sum(len(scene.cases) for scene in scenes) == 32
    with pytest.raises(shmmap.MapMissing):
        reference_scenes(data_dir)


def test_a_device_that_is_equal_passes_with_numpy_and_pyopencl_alone(packed: Path, tmp_path: Path) -> None:
    need_device()
    report = tmp_path / "report.json"
    done = subprocess.run(
        [sys.executable, "-c", BARE, "device-check", "--packed", str(packed), "--json", str(report)],
        capture_output=True,
        text=True,
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
        times = entry["latencies"]["street"]
        assert times["points"] == 400
        assert 0 < times["evaluation_ms"]["min"] <= times["evaluation_ms"]["p99"]
    double = next(entry for entry in document["devices"] if entry["precision"] == "double")
    assert max(check["worst"].get("t_m", 0.0) for check in double["checks"]) <= 1e-9


def test_what_is_not_equal_is_named(
    packed: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    need_device()
    source = program.kernel_source()
    term = "s[37] = ux * l02 + uy * l12 + uz * l22;"
    assert source.count(term) == 1
    monkeypatch.setattr(program, "kernel_source", lambda: source.replace(term, term.replace("+ uz", "- uz")))
    report, wrong = packed.with_name("out.json"), packed.with_name("wrong.npz")
    assert main(["device-check", "--packed", str(wrong), "--json", str(report)]) == 1
    out = capsys.readouterr().out
    assert "UNEQUAL: the original programs, wrong" in out
    assert "iterations, not 999" in out
    document = json.loads(report.read_text())
    assert document["equal"] is False
    failed = [
        check["what"] for entry in document["devices"] for check in entry["checks"] if check["failures"]
    ]
    assert any(what.startswith("evaluations") for what in failed)


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


def test_scenes_are_packed_by_the_program(
    tmp_path: Path, packed: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from shmmap_clients.ndt_scan_matcher.device_check import scenes

    monkeypatch.setattr(scenes, "town_scenes", lambda: load_scenes(packed))
    out = tmp_path / "made.npz"
    assert main(["device-check", "--pack", str(out)]) == 0
    assert "1 scenes" in capsys.readouterr().out
    assert load_scenes(out)[0].name == "street"
