# SPDX-License-Identifier: Apache-2.0
"""Reader of a ROS 2 parameter file in YAML: names, values, and the line of each.

The names may be at the top level, as in the file of Rolling-Bonxai, or under ``NODE: ros__parameters:``.
Nested names are joined by dots.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

import yaml

from shmmap.errors import ConfigError, MapMissing

Value: TypeAlias = bool | float | str | None

_ROS: Final = "ros__parameters"
_DEEPEST: Final = 16
_MAX_BYTES: Final = 1 << 20  # a parameter file has a few hundred
_TRUE: Final = frozenset({"true", "yes", "on", "y"})
_FALSE: Final = frozenset({"false", "no", "off", "n"})


class Entry(NamedTuple):
    """A parameter in the file.

    Attributes
    ----------
    value
        Value of the parameter; None for a list or an empty value.
    text
        Text of the value in the file; empty for a list.
    origin
        ``FILE:LINE``.
    """

    value: Value
    text: str
    origin: str


def read_parameter_file(path: str | os.PathLike[str]) -> dict[str, Entry]:
    """Return the parameters of a file by their names.

    Raises
    ------
    MapMissing
        There is no such file.
    ConfigError
        The file cannot be read or is not YAML; has no parameters or those of several nodes; or repeats one.
    """
    name = os.fspath(path)
    try:
        with Path(name).open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except FileNotFoundError:
        raise MapMissing(f"there is no file {name}") from None
    except OSError as error:
        raise ConfigError(f"{name}: {error.strerror}", origin=name) from error
    if len(data) > _MAX_BYTES:
        raise ConfigError(f"{name}: larger than a parameter file ever is", origin=name)
    try:
        text = data.decode("utf-8")
        _check_shape(text, name)
        root = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark is not None else ""
        raise ConfigError(f"{name}{line}: no YAML: {error.problem}", origin=f"{name}{line}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{name}: no YAML: {str(error).splitlines()[0]}", origin=name) from None
    if root is None:
        return {}
    entries: dict[str, Entry] = {}
    for key, node in _named(_parameters(root, name), name, ""):
        origin = f"{name}:{node.start_mark.line + 1}"
        if key in entries:
            raise ConfigError(
                f"{origin}: {key} again: it stands at {entries[key].origin}", key=key, origin=origin
            )
        entries[key] = Entry(*_value(node), origin)
    return entries


def _check_shape(text: str, name: str) -> None:
    """Refuse YAML that ROS 2 does not read either: aliases and very deep nesting, which would take long."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        mark = event.start_mark
        if depth > _DEEPEST or isinstance(event, yaml.AliasEvent):
            origin = f"{name}:{mark.line + 1}" if mark is not None else name
            what = "nested too deeply" if depth > _DEEPEST else "aliases are not read"
            raise ConfigError(f"{origin}: {what}", origin=origin)


def _parameters(root: yaml.Node, name: str) -> yaml.Node:
    """Find the mapping of parameters: the whole file, or the ``ros__parameters`` of a node."""
    if not isinstance(root, yaml.MappingNode):
        raise ConfigError(f"{name}: no parameters: need lines such as m_resolution: 0.05", origin=name)
    nodes: dict[str, yaml.Node] = {
        str(key.value): parameters
        for key, value in root.value
        if isinstance(value, yaml.MappingNode)
        for inner, parameters in value.value
        if inner.value == _ROS
    }
    if len(nodes) > 1:
        raise ConfigError(
            f"{name}: parameters of several nodes ({', '.join(nodes)})",
            origin=name,
            hint="leave those of one",
        )
    if not nodes:
        return root
    if len(root.value) > 1:
        strange = next(key for key, _ in root.value if key.value not in nodes)
        origin = f"{name}:{strange.start_mark.line + 1}"
        raise ConfigError(f"{origin}: {strange.value} stands beside a node, not in its {_ROS}", origin=origin)
    return next(iter(nodes.values()))


def _named(node: yaml.Node, name: str, prefix: str) -> Iterator[tuple[str, yaml.Node]]:
    if not isinstance(node, yaml.MappingNode):
        origin = f"{name}:{node.start_mark.line + 1}"
        raise ConfigError(f"{origin}: need lines such as m_resolution: 0.05", origin=origin)
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode):
            origin = f"{name}:{key.start_mark.line + 1}"
            raise ConfigError(f"{origin}: a name must be one word", origin=origin)
        if isinstance(value, yaml.MappingNode):
            yield from _named(value, name, f"{prefix}{key.value}.")
        else:
            yield f"{prefix}{key.value}", value


def _value(node: yaml.Node) -> tuple[Value, str]:
    """Read a value as ROS 2 does; unlike PyYAML, it accepts 1e-1 as a number."""
    if not isinstance(node, yaml.ScalarNode):
        return None, ""
    text = str(node.value)
    if node.style in ("'", '"', "|", ">"):
        return text, text
    if not text or text.lower() in ("~", "null"):
        return None, text
    if text.lower() in _TRUE | _FALSE:
        return text.lower() in _TRUE, text
    number = _number(text)
    return (number if number is not None else text), text


def _number(text: str) -> float | None:
    try:
        return float(text.lower().replace(".nan", "nan").replace(".inf", "inf")) if "_" not in text else None
    except ValueError:
        return None
