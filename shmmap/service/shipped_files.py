# SPDX-License-Identifier: Apache-2.0
"""The unit files and examples that come with the package.

They lie in ``systemd/`` of a checkout, and in a wheel inside the package.
"""

from __future__ import annotations

from pathlib import Path

import shmmap
from shmmap.errors import BadRequest, InternalError

__all__ = ["shipped_directory", "shipped_names", "shipped_text"]


def shipped_directory() -> Path:
    """Return the directory of the files.

    Raises
    ------
    InternalError
        The package was installed without them.
    """
    package = Path(shmmap.__file__).parent
    for place in (package / "_systemd", package.parent / "systemd"):
        if (place / "shmmap.toml").is_file():
            return place
    raise InternalError("this installation of shmmap came without its unit files")


def shipped_names() -> list[str]:
    """Return all names, relative to the directory: ``system/shmmapd.service``, ..."""
    root = shipped_directory()
    return sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())


def shipped_text(name: str) -> str:
    """Return the text of one file.

    Raises
    ------
    BadRequest
        There is no file of this name; the hint lists those there are.
    """
    if name not in shipped_names():
        raise BadRequest(f"there is no file {name!r}", hint="there are: " + ", ".join(shipped_names()))
    return (shipped_directory() / name).read_text(encoding="utf-8")
