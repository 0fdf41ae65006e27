# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap.cli`` is the same as ``shmmap``."""

from __future__ import annotations

import sys

from shmmap.cli import main

if __name__ == "__main__":
    sys.exit(main())
