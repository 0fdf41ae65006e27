# SPDX-License-Identifier: Apache-2.0
"""A process that maps segments with plain ``open`` and ``mmap``, and prints the checksums of what it maps.

As a program: ``python mapping_process.py PATH...`` maps each file, closes its descriptors, prints
``mapped``; for every line it reads it prints the CRC-32 of each mapping.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import zlib
from collections.abc import Sequence
from types import TracebackType


def _map(path: str) -> memoryview:
    """Map a file and close it: only the mapping keeps it in use (Python's mmap would keep a descriptor)."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = (
        ctypes.c_void_p,
        ctypes.c_size_t,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_long,
    )
    fd = os.open(path, os.O_RDONLY)
    size = os.fstat(fd).st_size
    address = libc.mmap(None, size, 1, 1, fd, 0)
    os.close(fd)
    if address in (None, ctypes.c_void_p(-1).value):
        raise OSError(ctypes.get_errno(), "mmap")
    return memoryview((ctypes.c_char * size).from_address(address)).cast("B")


class MappingProcess:
    """Runs this module as a program."""

    def __init__(self, paths: Sequence[str], *, command: Sequence[str] = ()) -> None:
        self.process = subprocess.Popen(
            [*command, sys.executable, "-I", __file__, *paths],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert self._line() == "mapped"

    def __enter__(self) -> MappingProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self.process.pid

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def checksums(self) -> list[int]:
        """CRC-32 of everything it maps, read now."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        return [int(word) for word in self._line().split()]

    def end(self) -> None:
        """Kill it and wait for its end."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except BrokenPipeError:
                    continue


def main() -> None:
    """Map the files named on the command line and answer until the input ends."""
    mapped = [_map(path) for path in sys.argv[1:]]
    print("mapped", flush=True)
    for _ in sys.stdin:
        print(*(zlib.crc32(view) for view in mapped), flush=True)


if __name__ == "__main__":
    main()
