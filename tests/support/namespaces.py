# SPDX-License-Identifier: Apache-2.0
"""Namespaces as containers have them."""

from __future__ import annotations

import subprocess

import pytest


def namespaces_or_skip(*flags: str) -> list[str]:
    """Return the command that makes these namespaces; the test is skipped where they are refused."""
    command = ["unshare", *flags, "--fork", "--kill-child"]
    try:
        done = subprocess.run(
            [*command, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, text=True
        )
    except FileNotFoundError:
        pytest.skip("there is no unshare")
    if done.returncode:
        pytest.skip(f"namespaces are refused: {done.stderr.strip()}")
    return command
