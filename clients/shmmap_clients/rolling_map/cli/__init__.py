# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-rolling``."""

from shmmap_clients.rolling_map.cli.entry import main

__all__ = ["main"]
