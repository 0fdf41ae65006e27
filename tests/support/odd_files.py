# SPDX-License-Identifier: Apache-2.0
"""What is in a file's place and no regular file, and calls of the kernel that fail."""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Final, NoReturn


def _directory(path: Path) -> None:
    path.mkdir()
    (path / "mine").write_text("kept")


def _socket(path: Path) -> None:
    fd = os.open(path.parent, os.O_PATH)  # the address of a socket is short
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(f"/proc/self/fd/{fd}/{path.name}")
    os.close(fd)


ODD_FILES: Final[dict[str, Callable[[Path], object]]] = {
    "pipe": os.mkfifo,
    "directory": _directory,
    "loop": lambda path: path.symlink_to(path.name),
    "socket": _socket,
    "device": lambda path: os.mknod(path, 0o600 | stat.S_IFCHR, os.makedev(1, 5)),  # /dev/zero; as root
}
"""By kind, what makes one; the directory is not empty."""


def failing(number: int) -> Callable[..., NoReturn]:
    """Return a function that fails with an error of the kernel, whatever it is given."""

    def fail(*_: object, **__: object) -> NoReturn:
        raise OSError(number, os.strerror(number))

    return fail
