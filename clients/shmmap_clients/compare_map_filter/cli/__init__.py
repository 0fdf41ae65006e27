# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-compare``."""

from shmmap_clients.compare_map_filter.cli.entry import main

__all__ = ["main"]
