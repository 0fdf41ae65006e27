# SPDX-License-Identifier: Apache-2.0
"""Compile Numba kernels for given types when their module is imported, and keep them on disk.

Kernels are in separate modules that are imported only where needed, so that other code does not load numba.
Every signature takes read-only arrays, which accepts writable ones, too.  (With writable signatures, the
first array from shared memory would trigger another compilation of some seconds.)

`shmmap.kernel_cache` keeps the files.  Numba's own cache is not used, since it trusts its files unchecked.
"""

from __future__ import annotations

import hashlib
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import llvmlite
import numba
import numba.core.compiler
import numba.core.serialize
from numba.core.caching import NullCache
from numba.core.typeinfer import register_dispatcher

from shmmap.compile_notices import notice
from shmmap.kernel_cache import discard, read_kernel, write_kernel
from shmmap.version import __version__

F = TypeVar("F", bound=Callable[..., Any])

_VERSIONS: Final = (__version__, numba.__version__, llvmlite.__version__)
_CompileResult: Any = numba.core.compiler.CompileResult
_dumps: Any = numba.core.serialize.dumps


class _KernelFiles(NullCache):
    """Cache interface for a dispatcher of numba: loads and stores compiled variants of its function.

    Parameters
    ----------
    function
        The Python function.
    source
        Content of the function's source file.
    """

    def __init__(self, function: Callable[..., Any], source: bytes) -> None:
        code = function.__code__
        closure = tuple(cell.cell_contents for cell in function.__closure__ or ())
        self._made_from = _dumps((_VERSIONS, source, code.co_code, closure))
        self._stem = f"{Path(code.co_filename).stem}.{function.__name__}-{code.co_firstlineno}"
        self._where = f"{code.co_filename} {function.__qualname__} {sys.implementation.cache_tag}"
        lines = source.splitlines()
        self._module, self._is_noticed = function.__module__, False
        self._number, self._of = _count(lines[: code.co_firstlineno]), _count(lines)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled variant for a signature; None if it has to be compiled."""
        target_context.refresh()
        name = self._name(sig, target_context.codegen())
        data = read_kernel(name, self._made_from)
        if data is not None:
            try:
                return _CompileResult._rebuild(target_context, *pickle.loads(data))  # noqa: S301  its owner was checked
            except Exception as error:  # noqa: BLE001  after any error the kernel can be compiled
                discard(name, error)
        if not self._is_noticed:  # once for all its types
            self._is_noticed = True
            notice(self._module, self._number, self._of)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store a variant, unless it is bound to this process."""
        if not data.library.has_dynamic_globals and not data.lifted:
            write_kernel(self._name(sig, data.codegen), self._made_from, _dumps(data._reduce()))

    def _name(self, signature: Any, codegen: Any) -> str:
        """Return a file's name, unique for the signature, the processor and the source's path."""
        key = f"{self._where} {signature} {codegen.magic_tuple()}"
        return f"{self._stem}.{hashlib.sha256(key.encode()).hexdigest()[:16]}.kernel"


def _count(lines: list[bytes]) -> int:
    """Return the number of kernels in some lines of a module."""
    return sum(line.startswith(b"@compiled(") for line in lines)


def read_only(dtype: Any, dimensions: int) -> Any:
    """Return the type of a C-contiguous array that is not written to."""
    return numba.types.Array(dtype, dimensions, "C", readonly=True)


def compiled(*signatures: Any, brief: bool = False, **settings: Any) -> Callable[[F], F]:
    """Compile a kernel for these signatures now; it runs without the interpreter lock.

    A ``brief`` kernel keeps the lock: among other threads, regaining it takes longer than the kernel.

    Parameters
    ----------
    *signatures
        Types of the arguments and of the result.  Without any, the kernel is compiled when it is first
        called with arguments of new types.
    brief
        Whether the kernel runs for a few microseconds only.
    **settings
        Further options of `numba.njit`.
    """

    def compile_now(function: F) -> F:
        kernel: Any = numba.njit(**{"nogil": not brief, "error_model": "numpy", **settings})(function)
        if kernel is function:  # NUMBA_DISABLE_JIT
            return function
        try:
            source = Path(function.__code__.co_filename).read_bytes()
        except OSError:
            pass  # without its source, stored variants cannot be checked
        else:
            kernel._cache = _KernelFiles(function, source)
        with register_dispatcher(kernel):
            for signature in signatures:
                kernel.compile(signature)
        if signatures:
            kernel.disable_compile()
        return cast("F", kernel)

    return compile_now


def inlined(function: F) -> F:
    """Make a function callable from kernels; compiled with its callers."""
    return cast("F", numba.njit(nogil=True, inline="always", error_model="numpy")(function))
