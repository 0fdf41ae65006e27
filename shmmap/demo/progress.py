# SPDX-License-Identifier: Apache-2.0
"""What a spectator sees while a demonstration runs."""

from __future__ import annotations

__all__ = ["Progress"]


class Progress:
    """Shows nothing; the command line has classes that do."""

    def stage(self, text: str, total: int) -> None:
        """Begin a stage of ``total`` steps."""

    def step(self, *lines: str) -> None:
        """Count a step of the stage; ``lines`` describe the state after it."""

    def event(self, text: str) -> None:
        """Show what has just happened."""
