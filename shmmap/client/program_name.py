# SPDX-License-Identifier: Apache-2.0
"""How a program is called that does not say so itself."""

from __future__ import annotations

import os
import sys
from typing import Final

__all__ = ["program_name"]

_LONGEST: Final = 64  # characters that the daemon keeps


def program_name() -> str:
    """Return the script's file name, or the module's name after ``python -m``; empty where there is neither.

    A module that is the ``__main__`` of a package goes by the package's name.
    """
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    if spec is not None and spec.name != "__main__":  # python -m package.module
        name: str = spec.name.removesuffix(".__main__")
    else:
        name = os.path.basename(sys.argv[0]) if sys.argv else ""
        if name in ("-c", "-"):  # python -c, and a program on standard input
            name = ""
    return name[:_LONGEST]
