# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap.origin.reread PARENT_PID MAP KNOWN``: read a map, given as JSON, for another process.

See `shmmap.origin.reading_apart`.  KNOWN is empty, or the digest of the names and boxes that the other
process has, as 16 hex digits.  The catalogue is also written into the cache.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from typing import Final

import msgspec

from shmmap.errors import InternalError, ShmmapError
from shmmap.origin.catalogue_bytes import write_catalogue
from shmmap.origin.map_directory import MapDirectory
from shmmap.origin.map_layout import OpenedDirectories
from shmmap.origin.metadata import MAX_METADATA_BYTES
from shmmap.origin.reading_apart import Outcome
from shmmap.processes.end_with_parent import die_with

_NICENESS: Final = 10  # the daemon's clients have priority
_MAX_BYTES: Final = 8 << 30
_MAX_CPU_S: Final = 600
"""Limits of memory and processor time for a map; ten million cells take 2.4 GB and 70 s."""


def main(arguments: list[str]) -> int:
    """Read the map and write the catalogue or the error."""
    die_with(int(arguments[0]), signal.SIGTERM)
    os.nice(_NICENESS)
    _limit(resource.RLIMIT_DATA, _MAX_BYTES)
    _limit(resource.RLIMIT_CPU, _MAX_CPU_S)
    words, descriptors = json.loads(arguments[1])
    origin = MapDirectory(**words)
    outcome, catalogue = Outcome(), None
    try:
        catalogue = origin.scanned(MAX_METADATA_BYTES, OpenedDirectories(descriptors))
    except ShmmapError as error:
        outcome = Outcome.of(error)
    except OSError as error:
        outcome = Outcome.of(ShmmapError(f"{origin.path}: {error}"))
    except MemoryError:
        said = f"{origin.path}: to read it takes more than {_MAX_BYTES >> 30} GiB of memory"
        outcome = Outcome.of(ShmmapError(said, hint="is its metadata sound?"))
    except Exception as error:  # noqa: BLE001  reported in the pipe: standard error is discarded
        outcome = Outcome.of(InternalError(f"{origin.path}: {type(error).__name__}: {error}"))
    with open(sys.stdout.fileno(), "wb", closefd=False) as out:
        out.write(msgspec.json.encode(outcome) + b"\n")
        if catalogue is not None:
            write_catalogue(out, "", (), catalogue, int(arguments[2], 16) if arguments[2] else None)
    return 0


def _limit(what: int, value: int) -> None:
    """Lower one of this process's resource limits to ``value``, unless it is lower already."""
    lower = [
        value if limit == resource.RLIM_INFINITY else min(value, limit) for limit in resource.getrlimit(what)
    ]
    resource.setrlimit(what, (lower[0], lower[1]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
