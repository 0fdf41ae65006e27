# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-elevation``."""

from shmmap_clients.elevation_map.cli.entry import main

__all__ = ["main"]
