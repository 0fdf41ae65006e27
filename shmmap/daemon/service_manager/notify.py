# SPDX-License-Identifier: Apache-2.0
"""Telling the service manager how we are (``sd_notify(3)``); does nothing when nobody listens."""

from __future__ import annotations

import contextlib
import os
import socket

__all__ = ["notify"]


def notify(*lines: str) -> None:
    """Send ``KEY=value`` lines to ``NOTIFY_SOCKET``, if there is one.

    A line break inside a value (a path may have one) becomes a blank: it would start another line.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel,
    ):
        text = "\n".join(line.replace("\n", " ") for line in lines)
        channel.sendto(text.encode(errors="replace"), address)
