# SPDX-License-Identifier: Apache-2.0
"""The command line: related verbs share a module, which imports what a verb needs when the verb runs."""

from __future__ import annotations

from shmmap.cli.entry import main, serve_main

__all__ = ["main", "serve_main"]
