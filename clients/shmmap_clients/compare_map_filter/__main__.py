# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.compare_map_filter`` is ``shmmap-compare``."""

import sys

from shmmap_clients.compare_map_filter.cli import main

if __name__ == "__main__":
    sys.exit(main())
