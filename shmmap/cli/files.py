# SPDX-License-Identifier: Apache-2.0
"""Files that options name to be written: refused before the work begins, or with what is wrong."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from shmmap.formats.durable_file import writing_errors

__all__ = ["output_file", "write_text", "writing_errors"]


def output_file(text: str) -> Path:
    """Read the name of a file to write, and find out before the work begins that it can be.

    Raises
    ------
    CannotWrite
        There is no such directory, or it or the file may not be written to.
    """
    path = Path(text)
    with writing_errors(str(path)):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        try:
            os.stat(os.path.join(path.parent, "."))  # a directory, and there
        except OSError as error:
            error.filename = text  # the name that the caller knows
            raise
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), text)
    return path


def write_text(path: Path, text: str) -> None:
    """Write a file; what keeps it from being written is `CannotWrite`."""
    with writing_errors(str(path)):
        path.write_text(text, encoding="utf-8")
