# SPDX-License-Identifier: Apache-2.0
"""The node of ``tests/support/autoware_node.cpp``, compiled with its own message types or with ROS 2's."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT

NODE: Final = ROOT / "tests" / "support" / "autoware_node.cpp"


def compiled_with(types: str, source: Path, folder: Path) -> Path | None:
    """Compile a program with these types; None where their generator is missing.

    Every warning is an error; the sanitizers of addresses and of undefined behaviour are part of it.
    """
    options: list[str] = []
    if types == "generated":
        found = generated_messages(folder)
        if found is None:
            return None
        options = ["-DSHMMAP_GENERATED", *found]
    program = folder / source.stem
    checks = ["-std=c++17", "-O0", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", *FLAGS]
    subprocess.run(["g++", *checks, *options, str(source), "-o", str(program), "-pthread"], check=True)
    return program


class AutowareNode:
    """One such process."""

    def __init__(self, program: Path) -> None:
        self._process = subprocess.Popen(
            [program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "ASAN_OPTIONS": "detect_leaks=1"},
        )

    def ask(self, *words: object) -> list[list[str]]:
        """Say something; returns the lines of the answer, each as its words."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(*words, sep="\t", file=self._process.stdin, flush=True)
        found: list[list[str]] = []
        for line in self._process.stdout:
            if line == "end\n":
                return found
            found.append(line.removesuffix("\n").split("\t"))
        raise AssertionError(f"it ended with {self._process.wait()}")

    def close(self) -> int:
        """Have it end; returns its exit code: not 0 where a sanitizer found something."""
        self._process.communicate()
        return self._process.returncode


# C++ types of Autoware's map service, by ROS 2's own generator, where Debian's rosidl is installed


GENERATORS: Final = Path("/usr/share/rosidl_generator_cpp/resource")
TYPES: Final = ("generated",) if GENERATORS.is_dir() else ("plain",)
"""The program's own types where ROS 2's generator is missing."""
_RUNTIMES: Final = ("rosidl_runtime_cpp", "rosidl_runtime_c", "rosidl_typesupport_interface")

_DEFINITIONS: Final = {
    "builtin_interfaces/msg/Time.msg": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header.msg": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "sensor_msgs/msg/PointField.msg": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n"
        "uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
    "sensor_msgs/msg/PointCloud2.msg": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    "autoware_map_msgs/msg/AreaInfo.msg": "float32 center_x\nfloat32 center_y\nfloat32 radius\n",
    "autoware_map_msgs/msg/PointCloudMapCellMetaData.msg": (
        "float32 min_x\nfloat32 min_y\nfloat32 max_x\nfloat32 max_y\n"
    ),
    "autoware_map_msgs/msg/PointCloudMapCellWithID.msg": (
        "string cell_id\nsensor_msgs/PointCloud2 pointcloud\nPointCloudMapCellMetaData metadata\n"
    ),
    "autoware_map_msgs/srv/GetDifferentialPointCloudMap.srv": (
        "AreaInfo area\nstring[] cached_ids\n---\nstd_msgs/Header header\n"
        "PointCloudMapCellWithID[] new_pointcloud_with_ids\nstring[] ids_to_remove\n"
    ),
}

# run by the system's Python, for which Debian installs rosidl
_GENERATE: Final = """
import json, pathlib, sys
from rosidl_adapter import convert_to_idl
from rosidl_generator_cpp import generate_cpp

folder, resources = map(pathlib.Path, sys.argv[1:])
for package in json.loads((folder / "packages.json").read_text()):
    tuples = []
    for path in sorted((folder / package).glob("*/*.[ms][sr][gv]")):
        relative = path.relative_to(folder / package)
        idl = convert_to_idl(folder / package, package, relative, folder / "idl" / package)
        tuples.append(f"{folder / 'idl' / package}:{idl.relative_to(folder / 'idl' / package)}")
    arguments = folder / f"{package}.json"
    arguments.write_text(json.dumps({
        "package_name": package, "output_dir": str(folder / "include" / package),
        "template_dir": str(resources), "idl_tuples": tuples,
        "ros_interface_dependencies": [], "target_dependencies": [],
    }))
    generate_cpp(str(arguments))
"""


def generated_messages(folder: Path) -> list[str] | None:
    """Generate the types into a directory; returns the compiler's options for them, None without rosidl."""
    if not GENERATORS.is_dir() or shutil.which("/usr/bin/python3") is None:
        return None
    for name, text in _DEFINITIONS.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    packages = sorted({name.split("/", 1)[0] for name in _DEFINITIONS})
    (folder / "packages.json").write_text(json.dumps(packages))
    done = subprocess.run(
        ["/usr/bin/python3", "-c", _GENERATE, str(folder), str(GENERATORS)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    runtimes = [Path("/usr/include") / name for name in _RUNTIMES]
    return [f"-isystem{path}" for path in [folder / "include", *runtimes]]
