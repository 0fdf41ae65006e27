# SPDX-License-Identifier: Apache-2.0
"""Entry point: ``python -m shmmap.daemon MAP ...`` is equivalent to ``shmmap serve MAP ...``."""

from __future__ import annotations

import sys

from shmmap.cli import serve_main

if __name__ == "__main__":
    sys.exit(serve_main())
