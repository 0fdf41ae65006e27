# SPDX-License-Identifier: Apache-2.0
"""Hears poses over ZeroMQ until it has as many as it wants, then prints them as JSON; knows only the wire."""

from __future__ import annotations

import json
import sys

import msgspec
import zmq


def main() -> None:
    """Listen to ``ADDRESS COUNT``."""
    address, count = sys.argv[1:]
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.subscribe(b"")
    socket.connect(address)
    print(json.dumps([msgspec.msgpack.decode(socket.recv()) for _ in range(int(count))]))
    socket.close(0)
    context.term()


if __name__ == "__main__":
    main()
