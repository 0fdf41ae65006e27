# SPDX-License-Identifier: Apache-2.0
"""Devices that are not there, cannot do what is asked, or fail: an error says so, and no harm is done."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import DeviceOptions, Limits, NdtMatcher, Scoring, Settings, VoxelMap
from shmmap_clients.ndt_scan_matcher.backends import opencl_backend
from shmmap_clients.ndt_scan_matcher.backends.backend import (
    Backend,
    DeviceError,
    DeviceHung,
    DeviceMemory,
    KernelBuildFailed,
    NoDevice,
)
from shmmap_clients.ndt_scan_matcher.backends.opencl import devices
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import (
    choose_device,
    list_devices,
    vendors_with_nvidia,
)
from shmmap_clients.ndt_scan_matcher.backends.opencl.map_memory import MapBuffers, in_large_pages
from shmmap_clients.ndt_scan_matcher.backends.opencl_backend import OpenclBackend
from shmmap_clients.ndt_scan_matcher.backends.registry import FallbackBackend
from shmmap_clients.ndt_scan_matcher.cli import main

import shmmap
from tests.clients.ndt_scan_matcher.scene import TRUTH, map_of, scan_from, worth
from tests.support.opencl_device import need_device
from tests.support.process_costs import anonymous_bytes, descriptors

HOW = Scoring("radius", "autoware")
COPY = DeviceOptions(memory="copy")
ROOT = Path(__file__).parents[4]


@pytest.fixture(scope="module", autouse=True)
def device() -> None:
    need_device()


def program_with(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "shmmap_clients.ndt_scan_matcher", *words],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )


def test_devices_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["devices"]) == 0
    lines = capsys.readouterr().out.splitlines()
    found = list_devices()
    assert [line.split(maxsplit=1)[0] for line in lines] == [str(info.index) for info in found]
    assert all(info.name in line for info, line in zip(found, lines, strict=True))
    assert main(["devices", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in listed] == [info.name for info in found]
    assert all(one["memory_bytes"] > 0 and one["driver"] for one in listed)


def test_a_device_is_chosen_by_index_name_or_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    info = next(info for info in list_devices() if not info.unusable)
    for wanted in (str(info.index), info.name, info.name[:5].upper()):
        assert choose_device(DeviceOptions(wanted)).info.name == info.name
    monkeypatch.setenv("SHMMAP_OPENCL_DEVICE", "no such device")
    with pytest.raises(NoDevice, match="no such device") as missing:
        choose_device(DeviceOptions())
    assert info.name in missing.value.hint
    assert choose_device(DeviceOptions(str(info.index))).info == info, "an option counts more"


def test_a_gpu_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    import dataclasses

    (one, handle), *_ = devices._found()
    kinds = ("CPU", "other", "GPU", "accelerator", "GPU")
    found = [(dataclasses.replace(one, index=n, kind=kind), handle) for n, kind in enumerate(kinds)]
    monkeypatch.setattr(devices, "_found", lambda: found)
    assert choose_device(DeviceOptions()).info.index == 2
    found[2] = (dataclasses.replace(found[2][0], unusable="its driver has no compiler"), handle)
    assert choose_device(DeviceOptions()).info.index == 4
    with pytest.raises(NoDevice, match="no compiler"):
        choose_device(DeviceOptions("2"))


def test_what_a_device_cannot_do_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import dataclasses

    (one, handle), *_ = devices._found()
    monkeypatch.setattr(devices, "_found", lambda: [(dataclasses.replace(one, fp64=False), handle)])
    with pytest.raises(NoDevice, match="double precision"):
        choose_device(DeviceOptions(precision="double"))
    assert not choose_device(DeviceOptions()).double
    with pytest.raises(NoDevice, match="in place"):
        choose_device(DeviceOptions(precision="float", memory="svm"))
    system = dataclasses.replace(one, svm_system=True)
    monkeypatch.setattr(devices, "_found", lambda: [(system, handle)])
    assert choose_device(DeviceOptions()).in_place
    assert not choose_device(DeviceOptions(memory="copy")).in_place
    assert not choose_device(DeviceOptions(precision="float")).in_place
    for wrong in ({"precision": "half"}, {"memory": "shared"}):
        with pytest.raises(shmmap.BadRequest):
            DeviceOptions(**wrong)  # type: ignore[arg-type]


def test_without_a_driver_the_error_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "vendors").mkdir()
    for environment in (
        {"OCL_ICD_VENDORS": str(tmp_path / "vendors")},
        # PoCL has no device where it has no cache
        {"POCL_CACHE_DIR": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere"},
    ):
        done = program_with("devices", **environment)
        assert done.returncode == 1
        assert "pocl-opencl-icd" in done.stderr
        done = program_with("warmup", "--backend", "opencl", **environment)
        assert done.returncode == 69
        assert "no OpenCL device" in done.stderr
        assert "pocl-opencl-icd" in done.stderr
        assert "POCL_CACHE_DIR" in done.stderr
        assert "Traceback" not in done.stderr


def test_a_cache_of_pyopencl_that_cannot_be_written_does_no_harm(tmp_path: Path) -> None:
    done = program_with(
        "warmup", "--backend", "opencl", XDG_CACHE_HOME="/proc/nowhere", POCL_CACHE_DIR=str(tmp_path)
    )
    assert done.returncode == 0, done.stderr
    assert "programs built" in done.stdout
    assert "computes what numpy does" in done.stdout


@pytest.mark.parametrize("precision", ["double", "float"])
def test_warmup_refuses_a_device_that_computes_something_else(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, precision: str
) -> None:
    words = ["warmup", "--backend", "opencl", "--precision", precision]
    assert main(words) == 0
    assert "computes what numpy does" in capsys.readouterr().out
    source = opencl_backend.kernel_source()
    term = "s[37] = ux * l02 + uy * l12 + uz * l22;"
    assert source.count(term) == 1
    wrong = source.replace(term, term.replace("+ uz", "- uz"))
    monkeypatch.setattr(opencl_backend, "kernel_source", lambda: wrong)
    assert main(words) == 1
    said = capsys.readouterr().err
    assert "computes something else than numpy (radius: " in said
    assert "hint: do not use it" in said


def test_a_program_that_does_not_build_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        opencl_backend, "kernel_source", lambda: "__kernel void evaluate() { no_such_function(1); }"
    )
    backend = OpenclBackend(Limits())
    with pytest.raises(KernelBuildFailed) as failed:
        backend.prepare(VoxelMap({}), HOW)
    assert "\n" not in str(failed.value)
    assert failed.value.exit_code == 69


def test_memory_that_a_device_has_not_is_an_error() -> None:
    backend = OpenclBackend(Limits(source_points=100))
    with pytest.raises(DeviceMemory, match="not enough memory"):
        MapBuffers(backend._context, backend.device, backend.device.info.max_bytes * 4)


def test_a_small_device_lowers_the_limit_on_the_map(
    points: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    from tests.support.opencl_device import as_if

    voxel_map = map_of(points, 2.0)
    needed = sum(cell.map_bytes for cell in voxel_map.cells.values())
    tables = 18 << 20
    as_if(monkeypatch, max_bytes=2 * (tables + needed // 2))
    with NdtMatcher(Settings(backend="opencl", device=COPY)) as matcher:
        most = matcher.limits.max_map_bytes
        assert most == needed // 2
        cut = VoxelMap(voxel_map.cells, max_bytes=most)
        assert 0 < sum(cell.map_bytes for cell in cut.cells.values()) <= most
        matcher.set_map(matcher.prepare(cut))
        assert matcher.align(scan_from(points, TRUTH, 300), np.eye(4)).cut.map_bytes == cut.bytes_left_out > 0
    as_if(monkeypatch, max_bytes=tables)
    with pytest.raises(DeviceMemory):
        OpenclBackend(Limits(), options=COPY)


def test_kinds_of_covariance_that_do_not_fit_side_by_side_take_turns(points: NDArray[np.float64]) -> None:
    scan = scan_from(points, TRUTH, 300)
    voxel_map = map_of(points, 2.0)
    free = OpenclBackend(Limits(source_points=300), options=COPY)
    free.prepare(voxel_map, HOW)
    backend = OpenclBackend(Limits(source_points=300), options=COPY)
    backend.maps = MapBuffers(backend._context, backend.device, free.maps.used_bytes)
    for one in (backend, free):
        one.set_source(scan)
        one.set_map(voxel_map)
    kinds = (HOW, Scoring("radius", "pcl"))
    backend.prepare(voxel_map, kinds[0])
    backend.prepare(voxel_map, kinds[1])
    assert backend.uploads.writes == 1
    for how in (*kinds, *kinds):
        assert worth(backend, TRUTH, how).score == worth(free, TRUTH, how).score
    assert backend.uploads.laid_out_again == 3
    assert free.uploads.laid_out_again == 0
    backend.maps = MapBuffers(backend._context, backend.device, free.maps.used_bytes // 4)
    backend.prepare(voxel_map, HOW)
    assert backend.maps.used_bytes == 0
    with pytest.raises(DeviceMemory, match="max-map-bytes"):
        worth(backend, TRUTH, HOW)


def test_ten_thousand_evaluations_grow_nothing(points: NDArray[np.float64]) -> None:
    scan = scan_from(points, TRUTH, 200)
    first, second = map_of(points, 2.0), map_of(points, 2.0, edge=10.0)
    backend = OpenclBackend(Limits(source_points=200), options=COPY)
    poses = TRUTH + np.zeros((20, 1))

    def work(rounds: int) -> None:
        for number in range(rounds):
            voxel_map = second if number % 2 else first
            backend.prepare(voxel_map, HOW)
            backend.set_map(voxel_map)
            backend.set_source(scan)
            for _ in range(30):
                worth(backend, TRUTH, HOW)
            backend.evaluate(poses, HOW)

    work(20)
    gc.collect()
    before, files, used = (
        anonymous_bytes(os.getpid()),
        descriptors(os.getpid()),
        backend.maps.used_bytes,
    )
    work(200)
    gc.collect()
    assert anonymous_bytes(os.getpid()) - before < 2_000_000
    assert descriptors(os.getpid()) == files
    assert backend.maps.used_bytes == used


@pytest.mark.parametrize("fallback", [None, "numba"])
def test_a_device_that_hangs_holds_up_no_caller(fallback: str | None) -> None:
    words = ["align", "0.5", *([fallback] if fallback else [])]
    done = subprocess.run(
        [sys.executable, "-m", "tests.support.opencl_device", *words],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=120,  # the process ends although the device does not
    )
    assert done.returncode == 0, done.stderr
    *lines, end = done.stdout.splitlines()
    assert end == "end"
    first, second = map(json.loads, lines)
    if fallback is None:
        assert first["error"] == second["error"] == "device_hung"
    else:
        assert first["late"] is True
        assert first["fault"] == second["fault"] == "device_hung"
        assert second["converged"] is True


class Failing:
    """A backend on a device that fails from a certain call on."""

    name = "opencl"
    on_device = True
    max_map_bytes = 1_000

    def __init__(self, calls: int, real: Backend) -> None:
        self._left = calls
        self.real = real

    def __getattr__(self, name: str) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            self._left -= 1
            if self._left < 0:
                raise DeviceHung("it does not answer")
            return getattr(self.real, name)(*arguments, **options)

        return call


@pytest.mark.parametrize("calls", range(7))
def test_wherever_a_device_fails_the_fallback_goes_on(points: NDArray[np.float64], calls: int) -> None:
    from shmmap_clients.ndt_scan_matcher.backends.numpy_backend import NumpyBackend

    limits = Limits(source_points=300)
    failing: Any = Failing(calls, NumpyBackend(limits))
    backend = FallbackBackend(failing, NumpyBackend(limits))
    assert backend.max_map_bytes == 1_000
    plain = NumpyBackend(limits)
    voxel_map, scan = map_of(points, 2.0), scan_from(points, TRUTH, 400)
    backend.prepare(voxel_map, HOW)
    for one in (backend, plain):
        one.set_map(voxel_map)
        assert one.set_source(scan) == 100
    for _ in range(2):
        assert worth(backend, TRUTH, HOW).score == worth(plain, TRUTH, HOW).score
    (many,) = backend.evaluate(TRUTH[None], HOW)
    assert many.score == worth(plain, TRUTH, HOW).score
    failed = calls < 6
    assert (backend.fault is not None) == failed
    assert (backend.name, backend.on_device) == (("numpy", False) if failed else ("opencl", True))


def test_a_fallback_does_not_hide_that_there_is_no_device() -> None:
    with pytest.raises(DeviceError):
        NdtMatcher(Settings(backend="opencl", device=DeviceOptions("no such device"), fallback="numba"))
    with pytest.raises(shmmap.BadRequest, match="fortran"):
        NdtMatcher(Settings(backend="opencl", fallback="fortran"))


def test_nvidias_driver_is_found_without_its_file(tmp_path: Path) -> None:
    vendors, empty, folder = tmp_path / "vendors", tmp_path / "empty", tmp_path / "lib"
    for path in (vendors, empty, folder):
        path.mkdir()
    (vendors / "pocl.icd").write_text("libpocl.so\n")
    assert vendors_with_nvidia(vendors, [empty, folder]) is None
    (folder / "libnvidia-opencl.so.1").touch()
    made = vendors_with_nvidia(vendors, [empty, folder])
    assert made is not None
    assert {file.name: file.read_text().strip() for file in made.iterdir()} == {
        "pocl.icd": "libpocl.so",
        "nvidia.icd": str(folder / "libnvidia-opencl.so.1"),
    }
    for file in made.iterdir():
        file.rename(vendors / file.name)
    made.rmdir()
    assert vendors_with_nvidia(vendors, [folder]) is None, "its file is there"
    only = vendors_with_nvidia(tmp_path / "nowhere", [folder])
    assert only is not None
    assert [file.name for file in only.iterdir()] == ["nvidia.icd"]


def test_memory_in_large_pages_is_memory() -> None:
    for nbytes in (1, 4096, (4 << 20) + 100):
        memory = in_large_pages(nbytes)
        assert (len(memory), memory.nbytes) == (nbytes, nbytes)
        assert memory.ctypes.data % (2 << 20) == 0
        assert not memory.any()
        memory[:] = 7
        assert (memory == 7).all()
    with pytest.raises(MemoryError, match="bytes"):
        in_large_pages(1 << 60)
