# SPDX-License-Identifier: Apache-2.0
"""The tree of errors: codes, what else an error is, and a clear line for a missing package or a bad file."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import shmmap
from shmmap import errors
from shmmap.errors import (
    CannotWrite,
    ConnectionLost,
    DaemonUnreachable,
    MapDataError,
    NoAnswer,
    NoColumn,
    PackageMissing,
    ShmmapError,
    error_from_wire,
)
from shmmap.formats.durable_file import writing_errors
from shmmap.lazy_imports import needed_packages


def kinds(root: type[ShmmapError] = ShmmapError) -> Iterator[type[ShmmapError]]:
    """The tree; other packages may have errors of their own."""
    yield root
    for kind in root.__subclasses__():
        if kind.__module__ == "shmmap.errors":
            yield from kinds(kind)


def test_each_kind_has_a_code_of_its_own_and_comes_back_from_it() -> None:
    found = list(kinds())
    assert len({kind.code for kind in found}) == len(found)
    for kind in found:
        error = error_from_wire(kind.code, "what", "do")
        assert type(error) is kind
        assert str(error) == "what (do)"
        assert (error.message, error.hint) == ("what", "do")
    assert type(error_from_wire("of_a_later_version", "what")) is ShmmapError


def test_the_picture_of_the_tree_is_the_tree() -> None:
    """Every class stands in it, below its base."""
    assert errors.__doc__ is not None
    drawn: dict[str, str] = {}
    above: list[str] = []
    for line in errors.__doc__.splitlines():
        match = re.match(r"    ([│ ]*)(?:[├└]── )?(\w+)", line)
        if match is None or not (match[2] == "ShmmapError" or "── " in line):
            continue
        depth = 0 if match[2] == "ShmmapError" else len(match[1]) // 4 + 1
        del above[depth:]
        drawn[match[2]] = above[-1] if above else ""
        above.append(match[2])
    assert drawn == {
        kind.__name__: "" if kind is ShmmapError else kind.__bases__[0].__name__ for kind in kinds()
    }


def test_errors_are_what_python_calls_them_too() -> None:
    with pytest.raises(TimeoutError, match="late"):
        raise NoAnswer("late")
    with pytest.raises(KeyError) as missing:
        raise NoColumn("no column 'a'", hint="it has b")
    assert str(missing.value) == "no column 'a' (it has b)", "without the quotes of a KeyError"
    with pytest.raises(ImportError):
        raise PackageMissing("numba")
    assert issubclass(NoAnswer, DaemonUnreachable)
    assert not issubclass(ConnectionLost, TimeoutError)


@pytest.mark.parametrize(
    ("module", "package"), [("nowhere_to_be_found", "nowhere_to_be_found"), ("yaml.nowhere", "PyYAML")]
)
def test_a_package_that_is_missing_is_one_line(module: str, package: str) -> None:
    with pytest.raises(PackageMissing) as missing, needed_packages("shmmap-ndt"):
        __import__(module)
    assert missing.value.message == f"shmmap-ndt needs the package {package}, which is not installed"
    assert f"pip install {package}; after a client-only install, `pip install .`" in missing.value.hint
    assert missing.value.__cause__ is None
    assert missing.value.__suppress_context__


def test_a_package_that_no_ordinary_install_brings_has_to_be_installed_by_name() -> None:
    with pytest.raises(PackageMissing) as missing, needed_packages("shmmap-ndt"):
        raise ModuleNotFoundError("No module named 'pyopencl'", name="pyopencl")
    assert missing.value.hint == "pip install pyopencl"
    with pytest.raises(PackageMissing) as missing, needed_packages("a map", together="obstore zstandard"):
        raise ModuleNotFoundError("No module named 'zstandard'", name="zstandard")
    assert "needs the package zstandard" in missing.value.message
    assert missing.value.hint == "pip install obstore zstandard"


def test_a_module_of_ours_that_is_missing_is_a_defect() -> None:
    with pytest.raises(ModuleNotFoundError) as missing, needed_packages("shmmap-ndt"):
        __import__("shmmap.nowhere")
    assert not isinstance(missing.value, PackageMissing)


CLIENT_ONLY = """
import sys

class Without:
    "What a client-only install lacks."

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {packages!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Without())
import shmmap
try:
    print({code})
except shmmap.ShmmapError as error:
    print(error.code, error)
"""


def said_without(packages: set[str], call: str) -> str:
    """Return what a program prints that makes this call where these packages are not installed."""
    code = "import numpy\n" + CLIENT_ONLY.format(packages=packages, code=call)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    "code",
    ["shmmap.layers.build_layer", "shmmap.read_cloud", "shmmap.layers.voxel_covariances", "shmmap.write_pcd"],
)
def test_every_public_name_of_a_client_only_install_works_or_says_what_it_needs(code: str) -> None:
    packages = {"xxhash", "lzf", "yaml", "numba", "open3d", "scipy", "pandas", "laspy"}
    said = said_without(packages, code)
    assert said.startswith("<function") or re.fullmatch(
        rf"package_missing {code} needs the package [\w-]+, which is not installed \(pip install .*\)\n", said
    ), said
    assert "pip install shmmap" not in said, "it is on no index"


@pytest.mark.parametrize(
    ("packages", "call", "what"),
    [
        ({"xxhash"}, "shmmap.layers.build_layer", "shmmap.layers.build_layer needs the package xxhash"),
        (
            {"numba"},
            "shmmap.layers.build_layer('voxel(leaf=1.0)', numpy.zeros((3, 3)))",
            "layer voxel needs the package numba",
        ),
        (
            {"numba"},
            "shmmap.layers.voxel_covariances(*[numpy.zeros((1, 3, 3))] * 2)",
            "voxel_covariances() needs the package numba",
        ),
        # a client-only install reads live maps
        (
            {"numba", "xxhash", "zstandard"},
            "shmmap.live.Voxels and shmmap.live.ScanFilter and shmmap.live.LiveMap.mapper(None, 'front')",
            "mapping needs the package numba",
        ),
    ],
)
def test_what_loads_a_package_only_when_it_is_called_says_so_too(
    packages: set[str], call: str, what: str
) -> None:
    assert said_without(packages, call).startswith(f"package_missing {what}")


def test_no_other_public_name_is_that_of_a_module() -> None:
    """To import the module would put it in the name's place."""
    here = Path(shmmap.__file__).parent
    modules = {path.stem for path in here.iterdir() if path.is_dir() or path.suffix == ".py"}
    assert modules & set(dir(shmmap)) == {"errors", "events", "layers", "live"}


# --- files that cannot be written -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error",
    [
        NoAnswer("no map within 60 s", hint="`shmmap status` says more"),
        ConnectionLost("the daemon ended"),
        MapDataError("no cloud"),
        PackageMissing("no package"),
    ],
)
def test_our_own_errors_go_through(error: ShmmapError) -> None:
    """Also those that are an OSError as well: a daemon that does not answer says nothing about a file."""
    with pytest.raises(type(error)) as caught, writing_errors("out.json"):
        raise error
    assert caught.value is error


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EIO])
def test_what_the_system_refuses_names_the_file(number: int) -> None:
    with pytest.raises(CannotWrite) as caught, writing_errors("out.json"):
        raise OSError(number, os.strerror(number))
    assert caught.value.message == f"cannot write out.json: {os.strerror(number)}"
