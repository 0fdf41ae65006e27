# SPDX-License-Identifier: Apache-2.0
"""Clients that wait for ever, because they speak ROS in another way than CycloneDDS: found, and told once."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

from shmmap_clients.ros_bridge.service_server import Requester, ServiceServer

__all__ = ["ADVICE", "Strangers"]

ADVICE: Final = "start it with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp"
_MOST: Final = 32


class Strangers:
    """Keeps up which strangers there are.

    Parameters
    ----------
    log
        Told of each once.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._told: dict[str, None] = {}
        self._now: list[dict[str, str]] = []

    @property
    def now(self) -> list[dict[str, str]]:
        """Those there are, at most 32: ``service``, and ``vendor`` of their DDS, which may be empty."""
        return self._now

    def look(self, clients: Iterable[tuple[ServiceServer, Requester]]) -> None:
        """Take in who is there."""
        found = [(server, one) for server, one in clients if one.stranger]
        for server, one in found:
            if one.name in self._told:
                continue
            self._told[one.name] = None
            whose = f", speaks {one.vendor}" if one.vendor else ""
            self._log(
                f"a client of {server.name} is no node of rmw_cyclonedds_cpp{whose}, and may wait for ever:"
                f" {ADVICE}"
            )
        while len(self._told) > 8 * _MOST:
            del self._told[next(iter(self._told))]
        self._now = [{"service": server.name, "vendor": one.vendor} for server, one in found[:_MOST]]
