# SPDX-License-Identifier: Apache-2.0
"""``shmmap version`` and ``shmmap cpp``: installed versions, and the location of the C++ header."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import NamedTuple

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import print_json, print_line, print_pairs
from shmmap.errors import InternalError

_EXIT = """\
Exit code: 0."""


class Versions(NamedTuple):
    """Versions, ``major.minor`` of the protocol and of the layouts of segments and of statistics."""

    shmmap: str
    protocol: str
    layout: str
    statistics: str
    python: str


def _versions() -> Versions:
    import platform

    from shmmap.protocol.messages import PROTOCOL_VERSION
    from shmmap.segment.layout import LAYOUT_VERSION
    from shmmap.statistics import layout as statistics

    layouts = (PROTOCOL_VERSION, LAYOUT_VERSION, statistics.LAYOUT_VERSION)
    protocol, segments, read = (".".join(map(str, version)) for version in layouts)
    return Versions(installed_version(), protocol, segments, read, platform.python_version())


def installed_version() -> str:
    """Return the version of this package, with the commit of a checkout."""
    from shmmap.version import build_version

    return build_version()


def add_version(subparsers: Subparsers) -> None:
    """Add the verb ``version``."""
    parser = add_verb(
        subparsers,
        "version",
        run_version,
        help="versions of program, protocol and segment layout",
        description="Print the versions of the program, its wire protocol and its segment layout.",
        output="run.outputs.versions_kind",
        epilog=_EXIT,
    )
    add_json_option(parser)


def run_version(args: argparse.Namespace) -> int:
    """Print the versions."""
    if args.json:
        print_json(_versions()._asdict())
    else:
        print_pairs(list(_versions()._asdict().items()))
    return 0


_CPP_EPILOG = """\
To compile with the header, in one of these ways:
  g++ -std=c++17 $(shmmap cpp --includes) PROGRAM.cpp
  PKG_CONFIG_PATH="$(shmmap cpp --pkgconfigdir)" pkg-config --cflags shmmap
  cmake -Dshmmap_DIR="$(shmmap cpp --cmakedir)" ...
In CMakeLists.txt: find_package(shmmap REQUIRED), target_link_libraries(PROGRAM PRIVATE shmmap::shmmap).
Exit code: 0."""


def add_cpp(subparsers: Subparsers) -> None:
    """Add the verb ``cpp``."""
    parser = add_verb(
        subparsers,
        "cpp",
        run_cpp,
        help="where the C++ header is",
        description="Print where C++ compilers and build systems find the header shmmap/shmmap.hpp.\n"
        "Without an option: how to compile with it.",
        epilog=_CPP_EPILOG,
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--includes", action="store_true", help="the option of compilers: -I and a directory")
    which.add_argument("--cmakedir", action="store_true", help="the directory of shmmapConfig.cmake")
    which.add_argument("--pkgconfigdir", action="store_true", help="the directory of shmmap.pc")


def prefix() -> Path:
    """Return the directory that contains ``include`` and ``share``.

    Raises
    ------
    InternalError
        The package was installed without these directories.
    """
    import shmmap

    package = Path(shmmap.__file__).parent
    for place in (package / "_cpp", package.parent / "clients" / "cpp"):
        if (place / "include" / "shmmap" / "shmmap.hpp").is_file():
            return place
    raise InternalError("this installation of shmmap came without its C++ header")


def run_cpp(args: argparse.Namespace) -> int:
    """Print one directory, or how to use them all."""
    root = prefix()
    includes = f"-I{root / 'include'}"
    if args.includes:
        print_line(shlex.quote(includes))  # like pybind11: for use in a shell or a Makefile
    elif args.cmakedir:
        print_line(str(root / "share" / "cmake" / "shmmap"))
    elif args.pkgconfigdir:
        print_line(str(root / "share" / "pkgconfig"))
    else:
        print_line(f"#include <shmmap/shmmap.hpp> is in {root / 'include'}: C++17, nothing to link")
        print_line(f"  g++ -std=c++17 {shlex.quote(includes)} PROGRAM.cpp")
        print_line("other ways: shmmap cpp --help")
    return 0
