# SPDX-License-Identifier: Apache-2.0
"""Numba kernels: compiled for given types when their module is imported, and kept on disk.

Kernels live in modules of their own that are imported where they are needed, so that nothing else pays for
numba.  Every signature takes read-only arrays (writable ones fit it too; the reverse would compile once
more, for seconds, on the first array out of shared memory).

`shmmap.kernel_cache` has the files.  Numba's own cache is not used: it trusts whatever is in its files.
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

from shmmap.kernel_cache import discard, read_kernel, write_kernel
from shmmap.version import __version__

__all__ = ["compiled", "inlined", "read_only"]

F = TypeVar("F", bound=Callable[..., Any])

_VERSIONS: Final = (__version__, numba.__version__, llvmlite.__version__)
_CompileResult: Any = numba.core.compiler.CompileResult
_dumps: Any = numba.core.serialize.dumps


class _KernelFiles(NullCache):
    """What a dispatcher of numba asks for compiled variants of its function, and gives them to.

    Parameters
    ----------
    function
        In Python.
    source
        Bytes of the file it is in.
    """

    def __init__(self, function: Callable[..., Any], source: bytes) -> None:
        code = function.__code__
        closure = tuple(cell.cell_contents for cell in function.__closure__ or ())
        self._made_from = _dumps((_VERSIONS, source, code.co_code, closure))
        self._stem = f"{Path(code.co_filename).stem}.{function.__name__}-{code.co_firstlineno}"
        self._where = f"{code.co_filename} {function.__qualname__} {sys.implementation.cache_tag}"

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the variant for a signature; None where it has to be compiled."""
        target_context.refresh()
        name = self._name(sig, target_context.codegen())
        data = read_kernel(name, self._made_from)
        if data is None:
            return None
        try:
            return _CompileResult._rebuild(target_context, *pickle.loads(data))  # noqa: S301  it was checked whose it is
        except Exception as error:  # noqa: BLE001  whatever is wrong with it, it can be compiled
            discard(name, error)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a variant, unless it is bound to this process."""
        if not data.library.has_dynamic_globals and not data.lifted:
            write_kernel(self._name(sig, data.codegen), self._made_from, _dumps(data._reduce()))

    def _name(self, signature: Any, codegen: Any) -> str:
        """Name of a file: another signature, processor or place of the source is another file."""
        key = f"{self._where} {signature} {codegen.magic_tuple()}"
        return f"{self._stem}.{hashlib.sha256(key.encode()).hexdigest()[:16]}.kernel"


def read_only(dtype: Any, dimensions: int) -> Any:
    """Return the type of a C-contiguous array that is not written to."""
    return numba.types.Array(dtype, dimensions, "C", readonly=True)


def compiled(*signatures: Any, brief: bool = False, **settings: Any) -> Callable[[F], F]:
    """Compile a kernel for these signatures now; it runs without the interpreter lock.

    A ``brief`` kernel keeps it: among other threads, getting the lock back takes longer than the kernel.

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
            pass  # without its source it is not known whether what was kept is still right
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
