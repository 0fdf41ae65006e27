# SPDX-License-Identifier: Apache-2.0
"""The command line: one file per verb, each importing what it needs only when it runs."""

from __future__ import annotations

from shmmap.cli.entry import main, serve_main

__all__ = ["main", "serve_main"]
