# SPDX-License-Identifier: Apache-2.0
"""Bounded LZF, the compression in ``binary_compressed`` PCD files.

A stream is a sequence of tokens (Marc Lehmann's liblzf, ``lzf_d.c``): a control byte below 32
starts a literal run of that many bytes plus one; otherwise its top three bits plus two are the
length of a copy from up to 8192 bytes back (7 means that one more length byte follows).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

LITERAL_RUN: Final = 32
MAX_RATIO: Final = 88  # three bytes of input become at most 264 of output
_LONG: Final = 7 << 5
TRUST_BYTES: Final = 64 << 20  # streams that claim more output are checked by `first_error` before allocation
_LIMIT_BYTES: Final = (1 << 32) - 1

_Bytes = NDArray[np.uint8]
_PROBE: Final = (b"\x01ab\x20\x01", b"ababa")  # two literals, then three bytes copied from two back


def decompress(data: _Bytes, output: _Bytes) -> bool:
    """Decompress the stream ``data`` into ``output``; False if the result does not fill it exactly.

    Both are contiguous, and shorter than 4 GiB (the format's size words).
    """
    if not output.size:
        return not data.size
    if not reachable(data.size, output.size):
        return False
    return (_native() or _through_module)(data, output)


def reachable(input_bytes: int, output_bytes: int) -> bool:
    """Whether any stream of ``input_bytes`` bytes can decompress to ``output_bytes`` bytes."""
    return 0 < output_bytes <= min(_LIMIT_BYTES, MAX_RATIO * input_bytes)


@lru_cache(maxsize=1)
def _native() -> Callable[[_Bytes, _Bytes], bool] | None:
    """Return liblzf's C function from the extension module; None if the module does not export it.

    The module's Python function allocates its result twice, which costs half as much as the decompression in
    page faults.  The C function writes to a given buffer.
    """
    import lzf  # a client process must not load the module

    try:
        function = ctypes.CDLL(lzf.__file__).lzf_decompress
    except (OSError, AttributeError):
        return None
    function.argtypes = (ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_uint)
    function.restype = ctypes.c_uint

    def run(data: _Bytes, output: _Bytes) -> bool:
        made: int = function(data.ctypes.data, data.size, output.ctypes.data, output.size)
        return made == output.size

    result = np.zeros(len(_PROBE[1]), np.uint8)
    works = run(np.frombuffer(_PROBE[0], np.uint8), result) and result.tobytes() == _PROBE[1]
    return run if works else None


def _through_module(data: _Bytes, output: _Bytes) -> bool:
    import lzf

    try:
        made: bytes | None = lzf.decompress(data.tobytes(), output.size)
    except ValueError:
        return False
    if made is None or len(made) != output.size:
        return False
    output[:] = np.frombuffer(made, np.uint8)
    return True


def first_error(data: memoryview[Any] | bytes, output_bytes: int) -> int | None:
    """Walk the tokens without decoding; return the offset of the first invalid one, or None."""
    at, made, size = 0, 0, len(data)
    while at < size:
        control = data[at]
        if control < LITERAL_RUN:
            step, length = control + 2, control + 1
            if at + step > size:
                return at
        else:
            step, length = 2, (control >> 5) + 2
            if control >= _LONG:
                step = 3
                if at + 1 < size:
                    length += data[at + 1]
            if at + step > size:
                return at
            if ((control & 31) << 8) + data[at + step - 1] + 1 > made:
                return at
        made += length
        if made > output_bytes:
            return at
        at += step
    return None if made == output_bytes else size


def compress(data: bytes) -> bytes:
    """Return ``data`` as an LZF stream; incompressible data becomes literal runs."""
    import lzf

    if not data:
        return b""
    longest = len(data) + -(-len(data) // LITERAL_RUN)
    shrunk: bytes | None = lzf.compress(data, longest) if len(data) > 8 else None
    if shrunk is not None:
        return shrunk
    runs = (data[at : at + LITERAL_RUN] for at in range(0, len(data), LITERAL_RUN))
    return b"".join(bytes((len(run) - 1,)) + run for run in runs)
