# SPDX-License-Identifier: Apache-2.0
"""One clear line where a Python package is missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from shmmap.errors import PackageMissing

__all__ = ["FOR_REMOTE", "TO_SIGN", "needed_packages"]

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
