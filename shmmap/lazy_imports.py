# SPDX-License-Identifier: Apache-2.0
"""Import public names on first use (PEP 562), and report a missing package in one clear line.

So importing a package takes almost no time.  A command starts even if not all packages are installed, and can
name the missing one.  The package imports its public names under ``if TYPE_CHECKING:``, for type checkers;
the same imports locate a name at its first use, so that there is no second list.
"""

from __future__ import annotations

import _ast  # `ast` itself takes a millisecond to load
import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from shmmap.errors import PackageMissing
from shmmap.installed import OURS, refuse_if_replaced
from shmmap.segment.process_limits import no_files_left

FOR_REMOTE: Final = "obstore zstandard"
"""Packages for a published map: the extra ``remote``."""
TO_SIGN: Final = "tuf 'securesystemslib[crypto]'"
"""Packages for a signed map: the extra ``sign``."""

_PACKAGES: Final = {
    "securesystemslib": "securesystemslib[crypto]",
    "cryptography": "securesystemslib[crypto]",
    "lzf": "python-neo-lzf",
    "yaml": "PyYAML",
    "zmq": "pyzmq",
    "open3d": "open3d-cpu",
}
"""Packages whose name differs from that of their module."""

_OPTIONAL: Final = frozenset(
    {
        "cyclonedds",
        "laspy",
        "obstore",
        "pyopencl",
        "rosbags",
        "securesystemslib[crypto]",
        "tifffile",
        "tuf",
        "viser",
        "websockets",
        "zstandard",
    }
)
"""Packages that an ordinary installation lacks: `project.optional-dependencies`."""

_names: dict[str, dict[str, str]] = {}
"""Module of each public name, by package; empty until the package's source has been read."""


@contextmanager
def needed_packages(what: str, *, together: str = "") -> Iterator[None]:
    """Replace the traceback of a failed import by an error that names the missing package.

    Parameters
    ----------
    what
        The function or program that needs the package.
    together
        Packages to install together, if one is of little use without the others.

    Raises
    ------
    PackageMissing
        A module outside of shmmap was not found.

    Examples
    --------
    >>> with needed_packages("shmmap-ndt"):
    ...     import numba
    """
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if not module or module in OURS:
            raise
        package = _PACKAGES.get(module, module)
        all_others = (
            ""
            if package in _OPTIONAL
            else ("; after a client-only install, `pip install .` in the checkout brings all packages")
        )
        raise PackageMissing(
            f"{what} needs the package {package}, which is not installed",
            hint=f"pip install {together or package}{all_others}",
        ) from None


def lazy_names(package: str) -> Callable[[str], Any]:
    """Return a package's ``__getattr__``, which loads names imported under ``if TYPE_CHECKING:``.

    Parameters
    ----------
    package
        The package's ``__name__``.
    """
    _names[package] = {}

    def load(name: str) -> Any:
        module = None if name.startswith("__") else public_names(package).get(name)
        if module is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(module), name)
        setattr(sys.modules[package], name, value)
        return value

    return load


def lazy_public_names(package: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` as `lazy_names` does, which reports a failed load in one clear line.

    The modules needed for the report are imported beforehand: later there may be no descriptor left.
    """
    load = lazy_names(package)

    def load_or_say(name: str) -> Any:
        try:
            with needed_packages(f"{package}.{name}"):
                return load(name)
        except (OSError, ImportError) as error:
            limit = no_files_left(error, f"{package}.{name} cannot be loaded: ")
            if limit is None:
                raise
            raise limit from None

    return load_or_say


def know_names() -> None:
    """Read now which public names the packages have that are imported: later an upgrade may replace them."""
    for package in tuple(_names):
        with suppress(ImportError):  # installed without its source
            public_names(package)


def public_names(package: str) -> dict[str, str]:
    """Return the module of each name that a package imports under ``if TYPE_CHECKING:``.

    Raises
    ------
    ImportError
        The package is installed without its source.
    Replaced
        The package was replaced before its names were read.
    """
    if not (found := _names.get(package)):
        refuse_if_replaced(package)
        found = _names[package] = _read_names(package)
    return found


def _read_names(package: str) -> dict[str, str]:
    spec: Any = sys.modules[package].__spec__
    source = spec.loader.get_source(package)
    if source is None:
        raise ImportError(f"{package} is installed without its source", name=package)
    tree: Any = compile(source, spec.origin, "exec", _ast.PyCF_ONLY_AST)
    return {
        alias.name: statement.module
        for block in tree.body
        if isinstance(block, _ast.If) and getattr(block.test, "id", "") == "TYPE_CHECKING"
        for statement in block.body
        if isinstance(statement, _ast.ImportFrom) and statement.module is not None
        for alias in statement.names
    }
