# SPDX-License-Identifier: Apache-2.0
"""Numba kernels: compiled for given types when their module is imported, and kept in numba's cache.

Kernels live in modules of their own that are imported where they are needed.  Every signature takes
read-only arrays: a read-only array is another type than a writable one, which fits it too, and the reverse
would compile once more, for seconds, on the first array out of shared memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = ["compiled", "float32_at", "float64_at", "inlined", "int32_at", "read_only"]

_Kernel = TypeVar("_Kernel", bound=Callable[..., Any])


def read_only(dtype: types.Type, dimensions: int) -> types.Array:
    """Return the type of a C-contiguous array that is not written to."""
    return types.Array(dtype, dimensions, "C", readonly=True)


def compiled(*signatures: Any, **settings: Any) -> Callable[[_Kernel], _Kernel]:
    """Compile a kernel for these signatures now; it runs without the interpreter lock.

    Parameters
    ----------
    *signatures
        Types of the arguments, and of the result.
    **settings
        More of `numba.njit`'s.
    """

    def compile_now(function: _Kernel) -> _Kernel:
        try:
            kernel = numba.njit(list(signatures), nogil=True, cache=True, **settings)(function)
        except RuntimeError:  # nowhere to keep a cache: compile in each process rather than fail
            kernel = numba.njit(list(signatures), nogil=True, **settings)(function)
        return cast("_Kernel", kernel)

    return compile_now


def inlined(function: _Kernel) -> _Kernel:
    """Make a function callable from kernels; compiled with whoever calls it."""
    return cast("_Kernel", numba.njit(nogil=True, inline="always")(function))


def _element_of(result: types.Type, llvm_type: ir.Type) -> Any:
    @intrinsic
    def load(_context: Any, _address: types.Type, _index: types.Type) -> tuple[Any, Callable[..., Any]]:
        """Return element ``_index`` of the array that starts at ``_address``."""

        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            pointer = builder.inttoptr(arguments[0], llvm_type.as_pointer())
            return builder.load(builder.gep(pointer, [arguments[1]]))

        return result(types.int64, types.int64), generate

    return load


# for kernels over many arrays at once, whose addresses are rows of a table: ``float32_at(address, index)``
float32_at = _element_of(types.float32, ir.FloatType())
float64_at = _element_of(types.float64, ir.DoubleType())
int32_at = _element_of(types.int32, ir.IntType(32))
