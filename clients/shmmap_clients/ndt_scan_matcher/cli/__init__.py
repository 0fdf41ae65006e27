# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-ndt``."""

from shmmap_clients.ndt_scan_matcher.cli.entry import main

__all__ = ["main"]
