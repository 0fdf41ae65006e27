# SPDX-License-Identifier: Apache-2.0
"""The bridge's participant in a DDS domain: names, settings of CycloneDDS, quality of service, closing.

ROS names become DDS names by the mangling of ``rmw``.  The user's settings (``CYCLONEDDS_URI``,
``ROS_AUTOMATIC_DISCOVERY_RANGE``, ``ROS_STATIC_PEERS``, ``ROS_LOCALHOST_ONLY``) have the same effect as for
nodes of rmw_cyclonedds_cpp.

All clients of a service read the same topic. A writer keeps its last samples (ten replies), and so never
waits for a reader that has stopped: this reader misses replaced samples, others are not affected.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Any, Final
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration

from shmmap import BadRequest
from shmmap.errors import CannotStart, ConfigError

_NAME: Final = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_MOST: Final = 200  # DDS allows 255, including a prefix, a suffix and the parameter services' part
MAX_DOMAIN: Final = 232
"""Highest domain number with valid UDP ports."""
_DOMAIN: Final = "<CycloneDDS><Domain Id='any'>{}</Domain></CycloneDDS>"
_LOCALHOST: Final = "<General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces></General>"
_NEAR: Final = (
    "<General><AllowMulticast>false</AllowMulticast><Interfaces>{}<NetworkInterface address='127.0.0.1'/>"
    "</Interfaces></General>"
)
"""Jazzy's nodes announce themselves by loopback, which newer versions of CycloneDDS ignore by default."""
_ANOTHER: Final = "<NetworkInterface autodetermine='true'/>"
_NO_MULTICAST: Final = "<General><AllowMulticast>false</AllowMulticast></General>"
_OFF: Final = (
    "<Discovery><ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{}</Tag></Discovery>"
)
_PEERS: Final = (
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    "<Peers>{}</Peers></Discovery>"
)
_RANGES: Final = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
_BLOCKING_MS: Final = 100


def resolved(name: str, namespace: str) -> str:
    """Return the full name; a name without a leading slash is in the namespace.

    Raises
    ------
    BadRequest
        The name is invalid for a topic or service.
    """
    full = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    if not _NAME.fullmatch(name) or not (namespace == "/" or _NAME.fullmatch(namespace)):
        bad = name if not _NAME.fullmatch(name) else namespace
        raise BadRequest(
            f"{bad!r} is no ROS name",
            hint="use letters, digits and _, parted by /; no part begins with a digit",
        )
    if not full.startswith("/"):
        full = f"/{full}"
    if len(full) > _MOST:
        raise BadRequest(f"{full[:40]}... has {len(full)} characters, of at most {_MOST}")
    return full


def node_name(name: str) -> str:
    """Return the name of a node if it is valid.

    Raises
    ------
    BadRequest
        The name has a slash or is otherwise invalid.
    """
    if "/" in name or not _NAME.fullmatch(name):
        raise BadRequest(f"{name!r} is no name of a node", hint="use letters, digits and _")
    return name


def topic(name: str) -> str:
    """Return the DDS name of a topic."""
    return f"rt{name}"


def request_topic(name: str) -> str:
    """Return the DDS name of a service's requests."""
    return f"rq{name}Request"


def reply_topic(name: str) -> str:
    """Return the DDS name of a service's replies."""
    return f"rr{name}Reply"


def settings(environ: Mapping[str, str] = os.environ) -> str:
    """Return the configuration of CycloneDDS: settings from ROS first, so that the user's override them.

    Raises
    ------
    ConfigError
        ``ROS_AUTOMATIC_DISCOVERY_RANGE`` has an unknown value.
    """
    within = environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"
    if within not in _RANGES:
        raise ConfigError(
            f"{within!r} is none of {', '.join(_RANGES)}",
            key="ROS_AUTOMATIC_DISCOVERY_RANGE",
            origin="environment",
        )
    peers = [one for one in environ.get("ROS_STATIC_PEERS", "").split(";") if one]
    ours = ""
    if environ.get("ROS_LOCALHOST_ONLY") == "1":
        ours = _LOCALHOST
    elif within == "OFF":
        ours = _NO_MULTICAST + _OFF.format(os.getpid())
    elif within == "LOCALHOST" or (within == "SUBNET" and peers):
        near = ["localhost"] if within == "LOCALHOST" else []
        listed = "".join(f"<Peer address={quoteattr(one)}/>" for one in [*near, *peers])
        ours = _NEAR.format(_ANOTHER if peers else "") if near else ""
        ours += _PEERS.format(listed)
    users = environ.get("CYCLONEDDS_URI", "")
    return ",".join([*([_DOMAIN.format(ours)] if ours else []), *([users] if users else [])])


def open_participant(domain: int) -> tuple[Domain, DomainParticipant]:
    """Join a domain; `close` both returned objects at the end.

    Raises
    ------
    CannotStart
        CycloneDDS refuses its settings, or has no network interface or no free port.
    BadRequest
        There is no such domain.
    """
    if not 0 <= domain <= MAX_DOMAIN:
        raise BadRequest(f"there is no domain {domain}", hint=f"it is 0 to {MAX_DOMAIN}")
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
    """Return the QoS of a reader or writer, with rclcpp's defaults for services.

    Parameters
    ----------
    user_data
        Data that other participants can read.
    depth
        Number of samples kept.
    latched
        Whether a late reader also gets the last samples (``transient_local``).
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
    """Close entities and their children now, instead of when Python collects them."""
    for one in entities:
        one.__del__()
