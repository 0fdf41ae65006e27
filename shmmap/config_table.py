# SPDX-License-Identifier: Apache-2.0
"""Metadata of settings: name, type, default, range and help, in the class that holds the values.

A field ``workers: int = setting(0, "most loader processes at a time", ...)`` is a row of a table.  The
options of ``shmmap serve``, the checks of the configuration file, their error messages, and the example file
are generated from these rows.  This module imports no other package, so that ``shmmap --help`` needs none.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from typing import Any, Final, NamedTuple, TypeVar

from shmmap.errors import ConfigError

T = TypeVar("T")

LARGEST_BYTES: Final = 1 << 62
_BEYOND: Final = 1 << 63
"""Larger than any limit; an integer may be too large for a float."""
_SIZE: Final = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?)(i?)b?\s*", re.IGNORECASE)
_TRUTHS: Final = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
_KINDS: Final = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    tuple: "a list of texts",
}
_PARSERS: Final[dict[type, Callable[[str], Any]]] = {
    bool: lambda text: _TRUTHS[text.lower()],
    int: int,
    float: float,
    str: str,
}


class Allowed(NamedTuple):
    """Values that a setting may have: a check, a text for hints, and all values if they are few."""

    accepts: Callable[[Any], bool]
    words: str = ""
    choices: tuple[str, ...] = ()


_ANYTHING: Final = Allowed(lambda _: True)


def within(lowest: float, highest: float, unit: str = "") -> Allowed:
    """Allow numbers in a range."""
    return Allowed(lambda value: lowest <= value <= highest, f"{lowest} to {highest} {unit}".rstrip())


def at_least(lowest: str) -> Allowed:
    """Allow sizes of at least ``lowest``, such as ``64K``."""
    nbytes = parse_bytes(lowest)
    return Allowed(lambda value: nbytes <= value <= LARGEST_BYTES, f"at least {lowest}")


def one_of(*choices: str) -> Allowed:
    """Allow only these texts."""
    return Allowed(choices.__contains__, f"{', '.join(choices[:-1])} or {choices[-1]}", choices)


def parse_bytes(text: str) -> int:
    """Parse a size such as ``512M``, ``2GiB`` or ``1000000`` (powers of 1024), at most 2^62 bytes.

    Raises
    ------
    ConfigError
        The text is not a size, or the size is too large.
    """
    match = _SIZE.fullmatch(text)
    nbytes = float(match[1]) * 1024.0 ** " kmgt".index(match[2].lower() or " ") if match else math.inf
    if not nbytes <= LARGEST_BYTES:
        raise ConfigError(f"{text!r} is no size", hint="write for example 512M or 2G")
    return int(nbytes)


@dataclass(frozen=True, slots=True)
class Row:
    """Metadata of one setting.

    Attributes
    ----------
    name
        Attribute that holds the value.
    default
        Default value; its type is the setting's type.
    help
        Description as a clause; in the example file it begins with a capital and ends with a full stop.
    metavar
        Name of the value on the command line; empty: the choices are listed.
    unset
        Meaning of an empty value, or 0, which is then allowed.
    size
        Name in files, variables and options of a size in bytes, whose attribute has another name.
    parse
        Parses the value from text if the type is not enough; raises ValueError or `ConfigError`.
    """

    name: str
    default: Any
    help: str
    metavar: str
    allowed: Allowed
    unset: str
    size: str
    parse: Callable[[str], Any] | None

    @property
    def called(self) -> str:
        """Name in files, and in lower case that of variables."""
        return self.size or self.name

    @property
    def hint(self) -> str:
        """Text that lists the allowed values."""
        words, unset = self.allowed.words, self.unset
        return (
            f"{words}; 0: {unset}" if words and unset and not isinstance(self.default, str | tuple) else words
        )

    def checked(self, value: Any, where: str, *, key: str, origin: str, as_text: bool = True) -> Any:
        """Return a value converted to the setting's type.

        Parameters
        ----------
        where
            Beginning of the message: the origin, and the setting's name there.
        as_text
            Whether numbers and booleans may be given as text, as in variables and options.

        Raises
        ------
        ConfigError
            The value has another type, or is not allowed.
        """
        kind = type(self.default)
        try:
            if isinstance(value, str) and as_text:
                value = (self.parse or (parse_bytes if self.size else _PARSERS[kind]))(value)
            elif kind is float and type(value) is int:
                value = float(max(-_BEYOND, min(value, _BEYOND)))
            elif kind is tuple and isinstance(value, list) and all(isinstance(one, str) for one in value):
                value = tuple(value)
            if type(value) is not kind:
                raise ValueError
        except ConfigError as error:
            raise ConfigError(f"{where}: {error.message}", key=key, origin=origin, hint=error.hint) from None
        except (KeyError, ValueError, OverflowError):
            default = f"its default is {self.toml(self.default)}"
            hint = "write it in quotes" if kind is str else f"{self.hint}; {default}".removeprefix("; ")
            raise ConfigError(
                f"{where} must be {_KINDS[kind]}, not {value!r}", key=key, origin=origin, hint=hint
            ) from None
        if not self.allowed.accepts(value) and not (self.unset and not value):
            raise ConfigError(f"{where} cannot be {value!r}", key=key, origin=origin, hint=self.hint)
        return value

    def toml(self, value: Any) -> str:
        """Return a value as written in a configuration file."""
        if self.size and value:
            for power, unit in ((3, "G"), (2, "M"), (1, "K")):
                if value % 1024**power == 0:
                    return f'"{value // 1024**power}{unit}"'
        # settings are texts, numbers, booleans and lists of texts, which TOML writes as JSON does
        return json.dumps(value, ensure_ascii=False)

    def option_help(self) -> str:
        """Return the help of the option: its description and default."""
        unset = f"; 0: {self.unset}" if self.unset and self.default else ""
        default = self.toml(self.default).strip('"').removesuffix(".0") if self.default else self.unset
        return f"{self.help}{unset}" + (f" (default: {default})" if default else "")

    def example(self, value: Any = None) -> tuple[str, str]:
        """Return the description for the example file, and the line that sets ``value`` or the default."""
        words = f"{self.help[:1].upper()}{self.help[1:]}."
        if self.unset:
            words += f"  {'Empty' if isinstance(self.default, str | tuple) else '0'}: {self.unset}."
        return words, f"{self.called} = {self.toml(self.default if value is None else value)}"


def setting(
    default: T,
    help: str,  # noqa: A002
    *,
    metavar: str = "",
    allowed: Allowed = _ANYTHING,
    unset: str = "",
    size: str = "",
    parse: Callable[[str], Any] | None = None,
) -> T:
    """Declare a field of a dataclass as a setting, see `Row`."""
    described = (help, metavar, allowed, unset, size, parse)
    return field(default=default, metadata={"setting": described})


def rows_of(kind: type) -> dict[str, Row]:
    """Return the settings of a dataclass by attribute, in order of declaration."""
    return {
        one.name: Row(one.name, one.default, *one.metadata["setting"])
        for one in fields(kind)
        if "setting" in one.metadata
    }


def near_hint(name: str, names: Iterable[str]) -> str:
    """Return the hint for an unknown setting: the most similar one, or all."""
    import difflib  # takes 6 ms, and only mistakes need it

    known = list(names)
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"settings are: {', '.join(known)}"
