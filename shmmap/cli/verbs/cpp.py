# SPDX-License-Identifier: Apache-2.0
"""``shmmap cpp``: where the C++ header is, for compilers and build systems.

A checkout has it in ``clients/cpp``, a wheel inside the package; below either is what a prefix such as
``/usr/local`` has: ``include``, ``share/cmake`` and ``share/pkgconfig``.
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from shmmap.cli.options import Subparsers, add_verb
from shmmap.cli.screens.output import print_line
from shmmap.errors import InternalError

__all__ = ["add_parser", "prefix", "run"]

_EPILOG = """\
To compile with the header, in one of these ways:
  g++ -std=c++17 $(shmmap cpp --includes) PROGRAM.cpp
  PKG_CONFIG_PATH="$(shmmap cpp --pkgconfigdir)" pkg-config --cflags shmmap
  cmake -Dshmmap_DIR="$(shmmap cpp --cmakedir)" ...
In CMakeLists.txt: find_package(shmmap REQUIRED), target_link_libraries(PROGRAM PRIVATE shmmap::shmmap).
Exit code: 0."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "cpp",
        run,
        help="where the C++ header is",
        description="Print where C++ compilers and build systems find the header shmmap/shmmap.hpp.\n"
        "Without an option: how to compile with it.",
        epilog=_EPILOG,
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--includes", action="store_true", help="the option of compilers: -I and a directory")
    which.add_argument("--cmakedir", action="store_true", help="the directory of shmmapConfig.cmake")
    which.add_argument("--pkgconfigdir", action="store_true", help="the directory of shmmap.pc")


def prefix() -> Path:
    """Return the directory that has ``include`` and ``share``.

    Raises
    ------
    InternalError
        The package was installed without them.
    """
    import shmmap

    package = Path(shmmap.__file__).parent
    for place in (package / "_cpp", package.parent / "clients" / "cpp"):
        if (place / "include" / "shmmap" / "shmmap.hpp").is_file():
            return place
    raise InternalError("this installation of shmmap came without its C++ header")


def run(args: argparse.Namespace) -> int:
    """Print a directory, or what to do with all of them."""
    root = prefix()
    includes = f"-I{root / 'include'}"
    if args.includes:
        print_line(shlex.quote(includes))  # as pybind11 does: for a shell or a Makefile
    elif args.cmakedir:
        print_line(str(root / "share" / "cmake" / "shmmap"))
    elif args.pkgconfigdir:
        print_line(str(root / "share" / "pkgconfig"))
    else:
        print_line(f"#include <shmmap/shmmap.hpp> is in {root / 'include'}: C++17, nothing to link")
        print_line(f"  g++ -std=c++17 {shlex.quote(includes)} PROGRAM.cpp")
        print_line("other ways: shmmap cpp --help")
    return 0
