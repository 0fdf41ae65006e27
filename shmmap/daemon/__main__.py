# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap.daemon MAP ...`` is ``shmmap serve MAP ...``."""

from __future__ import annotations

import sys

from shmmap.cli import serve_main

if __name__ == "__main__":
    sys.exit(serve_main())
