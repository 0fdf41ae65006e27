# SPDX-License-Identifier: Apache-2.0
"""When a connection comes and goes: libzmq says so, and a thread that does nothing else hears it at once."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Sequence
from queue import SimpleQueue
from typing import Any, Final

import zmq

__all__ = ["ConnectionWatch"]

_EVENT: Final = struct.Struct("=HI")  # first frame of a message of zmq_socket_monitor(3): event, value
_EVENTS: Final = (
    zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_CONNECT_RETRIED
    | zmq.EVENT_MONITOR_STOPPED
)


class ConnectionWatch:
    """What libzmq said of one socket's connection; read it from any thread.

    Parameters
    ----------
    socket
        Not connected yet.
    waiting
        Gets a None in each of these queues when the connection breaks; may change at any time.

    Attributes
    ----------
    handshakes : int
        How often the connection was made.
    lost_since : float or None
        `time.monotonic` of when it broke; None while it stands, and before it was first made.
    hung_up : bool
        The other side hung up before any handshake, and libzmq did not try again yet.
    foreign : bool
        Who listens speaks something else.
    """

    def __init__(self, socket: zmq.Socket[bytes], waiting: Sequence[SimpleQueue[Any]] = ()) -> None:
        self._waiting = waiting
        self.handshakes = 0
        self.lost_since: float | None = None
        self.hung_up = False
        self.foreign = False
        self._connected = threading.Event()
        self._monitor = socket.get_monitor_socket(_EVENTS)
        self._thread = threading.Thread(target=self._listen, name="shmmap-connection", daemon=True)
        self._thread.start()

    def wait_until_connected(self, timeout_s: float) -> None:
        """Wait for the first handshake."""
        self._connected.wait(max(timeout_s, 0.0))

    def stop(self, socket: zmq.Socket[bytes]) -> None:
        """End the thread; ``socket`` is the one that was given."""
        socket.disable_monitor()  # tells the thread
        if threading.current_thread() is self._thread:  # garbage is being collected in it
            self._monitor.close(linger=0)
        else:
            self._thread.join()

    def _listen(self) -> None:
        while not self._monitor.closed:
            # zmq.utils.monitor would do this, but loads asyncio (20 ms)
            event, _value = _EVENT.unpack(self._monitor.recv_multipart()[0])
            if event == zmq.EVENT_MONITOR_STOPPED:
                self._monitor.close(linger=0)
            elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self.handshakes += 1
                self.lost_since = None
                self._connected.set()
            elif event == zmq.EVENT_CONNECT_RETRIED:
                self.hung_up = False
            elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
                self.foreign = True
            else:
                self.hung_up = not self.handshakes
                if self.handshakes and self.lost_since is None:
                    self.lost_since = time.monotonic()
                    for queue in tuple(self._waiting):
                        queue.put(None)
