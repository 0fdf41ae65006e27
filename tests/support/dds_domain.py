# SPDX-License-Identifier: Apache-2.0
"""A DDS domain for one test: no other test of this machine is in it, and nothing leaves the machine."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

__all__ = ["FIRST_PORT", "URI", "dds_domain"]

_DOMAINS: Final = range(1, 100)  # the ports of higher ones are given to whoever asks for any port
_LOCKS: Final = Path("/tmp")

FIRST_PORT: Final = 7400
"""Of domain 0; each domain has 250 (DDSI-RTPS, 9.6.1)."""

URI: Final = (
    "<CycloneDDS><Domain Id='any'>"
    "<General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery>"
    "</Domain></CycloneDDS>"
)
"""Settings of CycloneDDS: the loopback interface alone, no multicast."""


@contextmanager
def dds_domain() -> Iterator[int]:
    """Have a domain to oneself; the kernel gives it back whatever becomes of this process."""
    for number in _DOMAINS:
        fd = os.open(
            _LOCKS / f"shmmap-test-dds-domain-{os.getuid()}-{number}.lock", os.O_RDWR | os.O_CREAT, 0o600
        )
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(fd)
            continue
        try:
            yield number
        finally:
            os.close(fd)
        return
    raise AssertionError("a hundred tests use DDS at once")
