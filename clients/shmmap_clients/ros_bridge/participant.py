# SPDX-License-Identifier: Apache-2.0
"""The bridge's part in a DDS domain: settings of CycloneDDS, qualities of service, closing.

Settings of the user (``CYCLONEDDS_URI``, ``ROS_LOCALHOST_ONLY``) count as they do for ROS nodes.

All clients of a service read the same topic. A writer keeps its last samples, ten of replies, and so never
waits for a reader that has stopped: that one misses what has been replaced, and the others notice nothing.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, Final

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration

from shmmap import BadRequest
from shmmap.errors import CannotStart

__all__ = ["MOST_DOMAIN", "close", "endpoint_qos", "open_participant", "settings"]

MOST_DOMAIN: Final = 232
"""Highest number of a domain: those above have no UDP ports."""

_LOCALHOST: Final = (
    "<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>"
    "</General></Domain></CycloneDDS>"
)
_BLOCKING_MS: Final = 100


def settings(environ: Mapping[str, str] = os.environ) -> str:
    """Return what CycloneDDS is configured with: what ROS says first, so that the user's counts over it."""
    localhost = [_LOCALHOST] if environ.get("ROS_LOCALHOST_ONLY") == "1" else []
    users = environ.get("CYCLONEDDS_URI", "")
    return ",".join([*localhost, *([users] if users else [])])


def open_participant(domain: int) -> tuple[Domain, DomainParticipant]:
    """Join a domain; `close` both.

    Raises
    ------
    CannotStart
        CycloneDDS refuses its settings, or has no network interface or no free port.
    BadRequest
        There is no such domain.
    """
    if not 0 <= domain <= MOST_DOMAIN:
        raise BadRequest(f"there is no domain {domain}", hint=f"it is 0 to {MOST_DOMAIN}")
    try:
        joined = Domain(domain, settings())
    except DDSException as error:
        raise CannotStart(
            f"CycloneDDS does not start: {error}", hint="is CYCLONEDDS_URI right? what it says stands above"
        ) from error
    try:
        return joined, DomainParticipant(domain, qos=Qos(Policy.Userdata(b"enclave=/;")))
    except DDSException as error:
        close(joined)
        raise CannotStart(
            f"cannot join domain {domain}: {error}", hint="is there a network interface, and a free UDP port?"
        ) from error


def endpoint_qos(user_data: str = "", *, depth: int = 10, latched: bool = False) -> Qos:
    """Return the qualities of a reader or writer, as rclcpp's defaults are for services.

    Parameters
    ----------
    user_data
        What others may read of it.
    depth
        How many samples are kept.
    latched
        Who comes late gets the last ones, too (``transient_local``).
    """
    policies: list[Any] = [
        Policy.Reliability.Reliable(duration(milliseconds=_BLOCKING_MS)),
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
    ]
    if latched:
        policies.append(Policy.DurabilityService(0, Policy.History.KeepLast(depth), -1, -1, -1))
    if user_data:
        policies.append(Policy.Userdata(user_data.encode()))
    return Qos(*policies)


def close(*entities: Any) -> None:
    """Close entities and all that they have made, now and not when Python comes round to it."""
    for one in entities:
        one.__del__()
