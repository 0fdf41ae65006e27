# SPDX-License-Identifier: Apache-2.0
"""How the programs' kernels are compiled."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from numba import types
from shmmap_clients.elements_at import float32_at, float64_at, int32_at

from shmmap.compiling import compiled, read_only


def total(values: Any) -> Any:
    result = 0.0
    for value in values:
        result += value
    return result


def test_one_variant_for_arrays_that_can_be_written_and_that_cannot() -> None:
    kernel: Any = compiled(types.float64(read_only(types.float64, 1)))(total)
    values = np.arange(4.0)
    shared = values.view()
    shared.flags.writeable = False
    assert (kernel(values), kernel(shared), len(kernel.signatures)) == (6.0, 6.0, 1)


def test_without_a_place_for_a_cache_kernels_compile_all_the_same() -> None:
    """As in a container whose packages, and home, cannot be written; here, code that is in no file."""
    made: dict[str, Any] = {}
    exec("def doubled(value): return 2 * value", made)
    with pytest.raises(RuntimeError, match="cannot cache"):
        numba.njit(types.int64(types.int64), cache=True)(made["doubled"])
    assert compiled(types.int64(types.int64))(made["doubled"])(21) == 42


def test_elements_at_an_address() -> None:
    @compiled(types.float64(types.int64, types.int64, types.int64))
    def product(floats: Any, doubles: Any, integers: Any) -> Any:
        return float32_at(floats, 1) * float64_at(doubles, 2) * int32_at(integers, 3)

    arrays = np.arange(2, dtype=np.float32) + 4, np.arange(3.0) + 5, np.arange(4, dtype=np.int32) - 9
    assert product(*(values.ctypes.data for values in arrays)) == 5 * 7 * -6
