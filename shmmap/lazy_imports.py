# SPDX-License-Identifier: Apache-2.0
"""Imports on first use: a package's public names (PEP 562), and one clear line where a package is missing.

So importing a package costs next to nothing, and a command line starts, and can say which package is missing,
where not all are installed.  The package imports its public names under ``if TYPE_CHECKING:``, for type
checkers; the same imports say where a name comes from when it is first used, so that there is no second list.
"""

from __future__ import annotations

import _ast  # `ast` itself takes a millisecond to load
import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from shmmap.errors import PackageMissing
from shmmap.segment.process_limits import no_files_left

__all__ = ["FOR_REMOTE", "TO_SIGN", "lazy_names", "lazy_public_names", "needed_packages", "public_names"]

FOR_REMOTE: Final = "obstore zstandard"
"""What a published map needs, together: the extra ``remote``."""
TO_SIGN: Final = "tuf 'securesystemslib[crypto]'"
"""What a signed map needs: the extra ``sign``."""

_PACKAGES: Final = {
    "securesystemslib": "securesystemslib[crypto]",
    "cryptography": "securesystemslib[crypto]",
    "lzf": "python-neo-lzf",
    "yaml": "PyYAML",
    "zmq": "pyzmq",
    "open3d": "open3d-cpu",
}
"""Packages that are not called as the module they bring."""

_OPTIONAL: Final = frozenset(
    {"cyclonedds", "laspy", "obstore", "pyopencl", "securesystemslib[crypto]", "tifffile", "tuf", "zstandard"}
)
"""Packages that no ordinary install brings: `project.optional-dependencies`."""

_OURS: Final = ("shmmap", "shmmap_clients")


@contextmanager
def needed_packages(what: str, *, together: str = "") -> Iterator[None]:
    """Say which package is missing where something is imported, instead of a traceback.

    Parameters
    ----------
    what
        What needs it: a function, a program.
    together
        What to install where one is of little use without others.

    Raises
    ------
    PackageMissing
        For the `ModuleNotFoundError` of any other module.

    Examples
    --------
    >>> with needed_packages("shmmap-ndt"):
    ...     import numba
    """
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if not module or module in _OURS:
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
    """Return a package's ``__getattr__``, which loads what the package imports under ``if TYPE_CHECKING:``.

    Parameters
    ----------
    package
        Its ``__name__``.
    """
    modules: dict[str, str] = {}

    def load(name: str) -> Any:
        if not modules:
            modules.update(public_names(package))
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(modules[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return load


def lazy_public_names(package: str) -> Callable[[str], Any]:
    """Return what `lazy_names` does; what keeps a name from being loaded is said in one clear line.

    What it needs for that is imported beforehand: there may be no descriptor left for it.
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


def public_names(package: str) -> dict[str, str]:
    """Return the module of each name that a package imports under ``if TYPE_CHECKING:``.

    Raises
    ------
    ImportError
        The package is installed without its source.
    """
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
