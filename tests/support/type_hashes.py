# SPDX-License-Identifier: Apache-2.0
"""Hashes of ROS types from their IDL: RIHS01 of REP 2016, SHA-256 over the types as a JSON text."""

from __future__ import annotations

import hashlib
import json
from typing import Any, get_args, get_type_hints

from cyclonedds.idl import IdlStruct

_IDS = {
    "int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9,
    "float32": 10, "float64": 11, "bool": 15, "str": 17,
}  # fmt: skip
_NESTED, _BYTE, _BOUNDED, _UNBOUNDED = 1, 16, 96, 144
_OCTETS = {("rcl_interfaces/msg/ParameterValue", "byte_array_value")}
"""Fields of `byte`, for which the IDL of CycloneDDS has no other type than `uint8`."""


def ros_name(kind: type[Any]) -> str:
    """The name of a type in ROS, ``sensor_msgs/msg/PointCloud2``."""
    package, folder, _, name = kind.__idl__.idl_transformed_typename.split("::")
    return f"{package}/{folder}/{name.rstrip('_')}"


def type_hash(kind: type[Any]) -> str:
    """The hash of a type, ``RIHS01_`` and 64 hexadecimal digits."""
    needed: dict[str, dict[str, Any]] = {}
    described = _described(kind, needed)
    whole = {
        "type_description": described,
        "referenced_type_descriptions": [needed[name] for name in sorted(needed)],
    }
    return f"RIHS01_{hashlib.sha256(json.dumps(whole).encode()).hexdigest()}"


def _described(kind: type[Any], needed: dict[str, dict[str, Any]]) -> dict[str, Any]:
    name = ros_name(kind)
    fields = []
    for field, annotation in get_type_hints(kind, include_extras=True).items():
        if name.endswith(("_Request", "_Response")) and field in ("client", "number"):
            continue  # what rmw_cyclonedds_cpp puts in front of the message
        element, offset, capacity = annotation, 0, 0
        described = [one for one in get_args(annotation)[1:] if type(one).__name__ == "sequence"]
        if described:
            element, capacity = described[0].subtype, described[0].max_length or 0
            offset = _BOUNDED if capacity else _UNBOUNDED
        nested = ""
        if isinstance(element, type) and issubclass(element, IdlStruct):
            nested, number = ros_name(element), _NESTED
            if nested not in needed:
                needed[nested] = {}
                needed[nested] = _described(element, needed)
        else:
            number = _BYTE if (name, field) in _OCTETS else _IDS[_primitive(element)]
        kind_of = {
            "type_id": number + offset,
            "capacity": capacity,
            "string_capacity": 0,
            "nested_type_name": nested,
        }
        fields.append({"name": field, "type": kind_of})
    return {"type_name": name, "fields": fields}


def _primitive(annotation: Any) -> str:
    return annotation.__name__ if isinstance(annotation, type) else str(get_args(annotation)[1])
