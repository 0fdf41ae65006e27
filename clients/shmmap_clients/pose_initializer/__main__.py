# SPDX-License-Identifier: Apache-2.0
"""``python -m shmmap_clients.pose_initializer`` is ``shmmap-pose-init``."""

import sys

from shmmap_clients.pose_initializer.cli import main

sys.exit(main())
