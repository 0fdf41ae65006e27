# SPDX-License-Identifier: Apache-2.0
"""Packets between a process and its children, received into one buffer that is there already.

`socket.recv_fds` makes a new buffer of the largest packet's size for each packet: half a mebibyte that the
kernel maps, and unmaps again.
"""

from __future__ import annotations

import array
import socket
from typing import Final

__all__ = ["MAX_PACKET_BYTES", "packet_buffer", "receive_packet"]

MAX_PACKET_BYTES: Final = 1 << 19
"""A job may name its cell and 65 neighbours by paths of 4095 bytes each."""

_ONE_DESCRIPTOR: Final = socket.CMSG_LEN(array.array("i").itemsize)


def packet_buffer() -> bytearray:
    """Return a buffer that takes the largest packet; what was never written to costs no memory."""
    return bytearray(MAX_PACKET_BYTES)


def receive_packet(channel: socket.socket, buffer: bytearray, *, wait: bool = True) -> tuple[memoryview, int]:
    """Receive one packet, and the descriptor that came with it.

    Parameters
    ----------
    wait
        False: `BlockingIOError` where there is none, whatever else the channel waits for.

    Returns
    -------
    data
        The packet, valid until the next one is received into ``buffer``; empty when the other end is closed.
    fd
        The descriptor, closed on exec; -1 for none.

    Raises
    ------
    OSError
        As `socket.socket.recvmsg`.
    """
    flags = socket.MSG_CMSG_CLOEXEC if wait else socket.MSG_CMSG_CLOEXEC | socket.MSG_DONTWAIT
    count, control, _flags, _address = channel.recvmsg_into([buffer], _ONE_DESCRIPTOR, flags)
    fd = -1
    for level, kind, data in control:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS) and len(data) >= 4:
            (fd,) = array.array("i", data[:4])
    return memoryview(buffer)[:count], fd
