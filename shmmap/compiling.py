# SPDX-License-Identifier: Apache-2.0
"""Numba kernels: compiled for given types when their module is imported, and kept on disk.

Kernels live in modules of their own that only builders import, so that nothing pays for numba
unless it builds a layer.  Every signature takes read-only arrays (writable ones fit it too; the
reverse would compile once more, for seconds, on the first array out of shared memory).

The cache is in `shmmap.kernel_cache.kernel_directory`; where it cannot be written, kernels are compiled in
each process.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numba
import numba.core.config

from shmmap.kernel_cache import kernel_directory

__all__ = ["compiled", "inlined", "read_only"]

F = TypeVar("F", bound=Callable[..., Any])


_config: Any = numba.core.config
_DIRECTORY: Final = kernel_directory()


def read_only(dtype: Any, dimensions: int) -> Any:
    """Return the type of a C-contiguous array that is not written to."""
    return numba.types.Array(dtype, dimensions, "C", readonly=True)


def compiled(*signatures: Any, brief: bool = False) -> Callable[[F], F]:
    """Compile a kernel for these signatures now; it runs without the interpreter lock.

    One that is ``brief`` keeps it: to get it back among other threads takes longer than some microseconds.

    Without a signature it is compiled when it is first called with arguments of new types.
    """

    def compile_now(function: F) -> F:
        before = _config.CACHE_DIR
        try:
            # numba chooses a function's cache when it is decorated, by this process-wide setting
            _config.CACHE_DIR = str(_DIRECTORY) if _DIRECTORY is not None else before
            dispatcher = numba.njit(
                list(signatures) or None, nogil=not brief, cache=_DIRECTORY is not None, error_model="numpy"
            )(function)
        finally:
            _config.CACHE_DIR = before
        return cast("F", dispatcher)

    return compile_now


def inlined(function: F) -> F:
    """Make a function callable from kernels; compiled with whoever calls it."""
    return cast("F", numba.njit(nogil=True, inline="always", error_model="numpy")(function))
