# SPDX-License-Identifier: Apache-2.0
"""A daemon that keeps one live map."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.support.daemon_process import DaemonProcess

__all__ = ["SETTINGS", "LiveDaemon", "worker_of"]

SETTINGS = """\
[live.lidar]
resolution = {resolution}
linger_s = 0.05
checkpoint_s = {checkpoint}
path = "{path}"
"""

LiveDaemon = Callable[..., DaemonProcess]


def worker_of(one: DaemonProcess) -> int:
    """Id of the live worker."""
    (found,) = (pid for pid in one.children() if b"live.worker" in Path(f"/proc/{pid}/cmdline").read_bytes())
    return found
