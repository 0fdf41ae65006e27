# SPDX-License-Identifier: Apache-2.0
"""LZF, the compression inside ``binary_compressed`` PCD files, with limits.

A stream is a sequence of tokens (Marc Lehmann's liblzf, ``lzf_d.c``): a control byte below 32
starts a literal run of that many bytes plus one; otherwise its top three bits plus two are the
length of a copy from up to 8192 bytes back (7 means that one more length byte follows).
"""

from __future__ import annotations

from typing import Final

__all__ = ["LITERAL_RUN", "MAX_RATIO", "compress", "decompress", "first_error"]

LITERAL_RUN: Final = 32
MAX_RATIO: Final = 88  # three bytes of input make at most 264 of output
_LONG: Final = 7 << 5
_TRUST_BYTES: Final = 64 << 20  # streams that claim more output are walked before memory is committed
_LIMIT_BYTES: Final = (1 << 32) - 1


def decompress(data: bytes, output_bytes: int) -> bytes | None:
    """Return the ``output_bytes`` bytes that ``data`` stands for, or None if it does not.

    ``output_bytes`` is at most 2**32 - 1 (the format's size words).  A stream that claims more than
    64 MiB and would fail is recognised before its output is allocated.
    """
    import lzf  # a client process must not load it

    if output_bytes == 0:
        return b"" if not data else None
    if not data or not 0 < output_bytes <= min(_LIMIT_BYTES, MAX_RATIO * len(data)):
        return None
    if output_bytes > _TRUST_BYTES + len(data) and first_error(data, output_bytes) is not None:
        return None
    try:
        output: bytes | None = lzf.decompress(data, output_bytes)
    except ValueError:
        return None
    return output if output is not None and len(output) == output_bytes else None


def first_error(data: bytes, output_bytes: int) -> int | None:
    """Walk the tokens without decoding; offset of the first bad one, or None for a sound stream."""
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
    """Return ``data`` as an LZF stream; data that does not shrink becomes literal runs."""
    import lzf

    if not data:
        return b""
    longest = len(data) + -(-len(data) // LITERAL_RUN)
    shrunk: bytes | None = lzf.compress(data, longest) if len(data) > 8 else None
    if shrunk is not None:
        return shrunk
    runs = (data[at : at + LITERAL_RUN] for at in range(0, len(data), LITERAL_RUN))
    return b"".join(bytes((len(run) - 1,)) + run for run in runs)
