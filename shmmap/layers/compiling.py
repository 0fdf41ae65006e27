# SPDX-License-Identifier: Apache-2.0
"""Kernels of all layers compiled and kept, before anybody needs one: some seconds, once on a machine."""

from __future__ import annotations

import contextlib
import fcntl

from shmmap.kernel_cache import all_kept, compiled_mark

__all__ = ["compile_kernels"]


def compile_kernels(*, wait: bool = True) -> None:
    """Compile what is not compiled yet, if it can be kept.

    Parameters
    ----------
    wait
        For another process that is at it; else it is left to that.

    Raises
    ------
    MemoryError
        There is not enough memory for the compiler.
    """
    mark = compiled_mark()
    if mark is None or mark.is_file():
        return
    with contextlib.ExitStack() as stack:
        try:
            lock = stack.enter_context(mark.with_suffix(".lock").open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError:  # another process is at it, or nothing can be kept: each process compiles its own
            return
        from shmmap.layers import (
            height_kernels,
            lattice_kernels,
            ndt_kernels,
        )  # compiled as they are imported

        del height_kernels, lattice_kernels, ndt_kernels
        if all_kept():
            with contextlib.suppress(OSError):
                mark.touch()
