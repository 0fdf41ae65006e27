# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.demo`` drives with three programs on one daemon."""

import sys

from shmmap_clients.demo.entry import main

if __name__ == "__main__":
    sys.exit(main())
