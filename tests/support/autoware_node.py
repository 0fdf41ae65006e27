# SPDX-License-Identifier: Apache-2.0
"""Programs in C++ with messages of ROS 2: with types of their own, or with those of its generator."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Final

from tests.support.cpp_client import FLAGS
from tests.support.daemon_process import ROOT
from tests.support.ros.definitions import DEFINITIONS

NODE: Final = ROOT / "tests" / "support" / "autoware_node.cpp"
SERVICES: Final = ROOT / "tests" / "support" / "map_services.cpp"


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
    options.append(f"-I{ROOT / 'clients' / 'ros' / 'include'}")
    subprocess.run(["g++", *checks, *options, str(source), "-o", str(program), "-pthread"], check=True)
    return program


class AutowareNode:
    """A process of `NODE`, or of another program that is asked in lines of words."""

    def __init__(self, program: Path, end: str = "end") -> None:
        self._end = f"{end}\n"
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
            if line == self._end:
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
    packages = ["autoware_map_msgs", "builtin_interfaces", "sensor_msgs", "std_msgs"]
    for name, text in DEFINITIONS.items():
        path = folder / name
        if path.parts[len(folder.parts)] in packages:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
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
