# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.ndt_scan_matcher`` is ``shmmap-ndt``."""

import sys

from shmmap_clients.ndt_scan_matcher.cli import main

sys.exit(main())
