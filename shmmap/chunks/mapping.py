# SPDX-License-Identifier: Apache-2.0
"""Chunks in the address space: mapped once, as long as a chunk can get, whatever the file has now.

Only as much as the file has may be touched.  (Python's own `mmap` refuses to map more than that.)
"""

from __future__ import annotations

import ctypes
import os
from typing import Any, Final

from shmmap.chunks.layout import MOST_BYTES, ChunkView

__all__ = ["map_chunk", "unmap_chunk", "view_at"]

_PROT_READ: Final = 0x1
_PROT_WRITE: Final = 0x2
_MAP_SHARED: Final = 0x1
_FAILED: Final = ctypes.c_void_p(-1).value

_libc: Any = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]
_libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]


def map_chunk(fd: int, name: str, *, writable: bool = False) -> int:
    """Map the file of a chunk; returns the address.

    Raises
    ------
    OSError
        The process has no room for more mappings, or the file may not be mapped so.
    """
    protection = _PROT_READ | _PROT_WRITE if writable else _PROT_READ
    address = _libc.mmap(None, MOST_BYTES, protection, _MAP_SHARED, fd, 0)
    if address == _FAILED:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), name)
    return int(address)


def view_at(address: int, size: int) -> ChunkView:
    """Arrays over the first bytes of a mapped chunk; nothing keeps the mapping for them."""
    return ChunkView((ctypes.c_char * size).from_address(address))


def unmap_chunk(address: int) -> None:
    """Unmap it: no view of it may be used any more."""
    _libc.munmap(address, MOST_BYTES)
