# SPDX-License-Identifier: Apache-2.0
"""How messages become samples of DDS and back, beside what `cyclonedds` does by itself.

A request and a reply begin with 16 bytes that rmw_cyclonedds_cpp puts in front of the message (its
``serdata.hpp``): which client asked, and its number of the request.  The server sends both back, and the
client takes the reply that has its own.  Each type here that has them is a request or a reply.

Replies with points are written by hand (`shmmap_clients.ros_bridge.cdr`): the serializer of `cyclonedds`
handles each byte of a sequence in Python.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, TypeVar

from cyclonedds.idl.annotations import final

__all__ = ["Damaged", "ServiceKind", "ready_made", "sample"]

_Sample = TypeVar("_Sample")


@dataclass
class Damaged:
    """What came instead of a message: bytes that are no message of its type.

    Attributes
    ----------
    reason
        What is wrong with them.
    """

    reason: str


def sample(kind: type[_Sample]) -> type[_Sample]:
    """Let a class of messages be sent as bytes that were made ready, and survive bytes that are no message.

    It is laid out as all of ROS: fields one after another and nothing else (``final``).
    """
    kind.serialize = _serialize  # type: ignore[attr-defined]
    kind.deserialize = classmethod(_deserialize)  # type: ignore[attr-defined]
    kind.ready = None  # type: ignore[attr-defined]  # no annotation: it is no field of the message
    return final(kind)  # type: ignore[no-any-return]


def _serialize(
    self: Any, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None
) -> bytes | bytearray:
    """Return those bytes, or make some of the fields."""
    made: bytes | bytearray = (
        self.__idl__.serialize(self, buffer=buffer, endianness=endianness, use_version_2=use_version_2)
        if self.ready is None
        else self.ready
    )
    return made


def _deserialize(cls: Any, data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> Any:
    """Return the message, or `Damaged`.

    Cyclone has dropped before what does not fit the type; texts that are not UTF-8 are left, for one.
    """
    try:
        return cls.__idl__.deserialize(data, has_header=has_header, use_version_2=use_version_2)
    except (ValueError, struct.error, IndexError, OverflowError, MemoryError) as error:
        return Damaged(f"{type(error).__name__}: {error}")


def ready_made(kind: type[_Sample], content: bytearray) -> _Sample:
    """Return a message that is sent as these bytes, encapsulation included; its fields are not set."""
    one = kind.__new__(kind)
    one.ready = content  # type: ignore[attr-defined]
    return one


@dataclass(frozen=True, slots=True)
class ServiceKind:
    """A service's types.

    Attributes
    ----------
    name
        As ROS writes it, ``autoware_map_msgs/srv/GetPartialPointCloudMap``.
    request, reply
        Classes of the messages.
    """

    name: str
    request: type[Any]
    reply: type[Any]
