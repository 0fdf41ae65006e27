# SPDX-License-Identifier: Apache-2.0
"""Elements of arrays by address, for kernels over many arrays whose addresses are in a table.

Functions such as ``float32_at(address, index)``; `shmmap.compiling` compiles the kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _element_of(result: types.Type, llvm_type: ir.Type) -> Any:
    @intrinsic
    def load(_context: Any, _address: types.Type, _index: types.Type) -> tuple[Any, Callable[..., Any]]:
        """Return element ``_index`` of the array that starts at ``_address``."""

        def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
            pointer = builder.inttoptr(arguments[0], llvm_type.as_pointer())
            return builder.load(builder.gep(pointer, [arguments[1]]))

        return result(types.int64, types.int64), generate

    return load


float32_at = _element_of(types.float32, ir.FloatType())
float64_at = _element_of(types.float64, ir.DoubleType())
int32_at = _element_of(types.int32, ir.IntType(32))
