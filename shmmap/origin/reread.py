# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap.origin.reread MAP``: read a map, a `MapDirectory` as JSON, into its sidecar.

Python's share of reading a million cells takes seconds, during which nobody else in a process would have the
interpreter, and memory that is not given back.  So a daemon has it done here.
"""

from __future__ import annotations

import json
import os
import sys

from shmmap.origin.map_directory import MapDirectory

__all__ = ["main"]

_NICENESS = 10  # whoever is being served goes first


def main(arguments: list[str]) -> int:
    """Run; a map that cannot be read ends it with a traceback, and is read again by who asked."""
    os.nice(_NICENESS)
    MapDirectory(**json.loads(arguments[0])).scanned()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
