# SPDX-License-Identifier: Apache-2.0
"""Kernels of layers are compiled before anybody asks for a layer: once on a machine, for some seconds.

A child of the loaders' parent does it, behind everything else that the machine has to do.  If it dies, or
there is not enough memory for it, whoever needs a kernel compiles it, as without it.
"""

from __future__ import annotations

import contextlib
import os
import socket
import traceback
from typing import Final, NoReturn

from shmmap.kernel_cache import compiled_mark
from shmmap.processes.end_with_parent import die_with

__all__ = ["compile_in_child", "is_compiled"]

_LEAST: Final = 19  # niceness


def is_compiled() -> bool:
    """Whether there is nothing to do: all is compiled, or cannot be kept."""
    mark = compiled_mark()
    return mark is None or mark.is_file()


def compile_in_child(channel: socket.socket) -> int:
    """Begin to compile; returns the child's pid.

    Parameters
    ----------
    channel
        This process's, which the child closes.
    """
    ours = os.getpid()
    pid = os.fork()
    if not pid:
        channel.close()
        _compile(ours)
    return pid


def _compile(parent: int) -> NoReturn:
    code = 1
    try:
        die_with(parent)
        os.setsid()
        os.nice(_LEAST)
        from shmmap.layers.compiling import compile_kernels

        with contextlib.suppress(MemoryError):
            compile_kernels(wait=False)  # else another daemon is at it
        code = 0
    except BaseException:  # noqa: BLE001  nothing of the parent's may run in here any more
        traceback.print_exc()
    finally:
        os._exit(code)
