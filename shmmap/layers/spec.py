# SPDX-License-Identifier: Apache-2.0
"""Registry of layer kinds, and parser of layer specs with their canonical form.

::

    spec     = name [ "(" argument { "," argument } ")" ]
    argument = number | name "=" number | "of" "=" spec

``ndt(2)``, ``ndt( leaf = 2.0, min_points=6 )`` and ``ndt(leaf=2.0)`` name the same layer; the last spec is
its canonical form: parameters by name in the kind's order, defaults left out, floats as Python prints
them.  ``of`` names the layer that a layer is built of: ``ndt(leaf=2.0,of=voxel(leaf=0.1))``.

Another package offers a kind by an entry point of the group ``shmmap.layers`` whose object is a
`LayerKind`::

    [project.entry-points."shmmap.layers"]
    roughness = "my_package.roughness:KIND"
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from shmmap.errors import BadRequest
from shmmap.layers.contract import LayerKind, Value
from shmmap.layers.ground import ELEVATION, GROUND, SEARCH
from shmmap.layers.points import POINTS
from shmmap.layers.selections import CROP, DENOISE, NORMALS, SAMPLE
from shmmap.layers.voxels import NDT, VOXEL
from shmmap.logfmt import log

GROUP: Final = "shmmap.layers"

_own: Final[dict[str, LayerKind]] = {
    kind.name: kind
    for kind in (POINTS, VOXEL, NDT, SEARCH, SAMPLE, CROP, DENOISE, NORMALS, ELEVATION, GROUND)
}
_registered: Final[dict[str, LayerKind]] = {}


def register(kind: LayerKind) -> None:
    """Register a kind in this process; an entry point registers it in all processes.

    Raises
    ------
    ValueError
        Another kind has the same name.
    """
    if (find_kind(kind.name) or kind) is not kind or not kind.name.isidentifier() or not kind.name.isascii():
        raise ValueError(f"a layer kind cannot be called {kind.name!r}")
    if not 1 <= kind.builder_version <= 255:
        raise ValueError(f"{kind.name}: builder_version must be 1 to 255")
    _registered[kind.name] = kind


@lru_cache(maxsize=1)
def _offered() -> dict[str, LayerKind]:
    """Return the kinds of other packages; a kind that cannot be loaded is left out and logged."""
    from importlib.metadata import entry_points  # imported late: a tenth of a loader's import time

    found: dict[str, LayerKind] = {}
    for entry in entry_points(group=GROUP):
        try:
            kind = entry.load()
        except Exception as error:  # noqa: BLE001  another package's module: anything may happen in it
            log.error("layer kind not loaded", kind=entry.name, module=entry.value, error=error)
            continue
        if not isinstance(kind, LayerKind) or kind.name != entry.name or kind.name in _own:
            log.error("layer kind not offered by its module", kind=entry.name, module=entry.value)
            continue
        found[kind.name] = kind
    return found


def find_kind(name: str) -> LayerKind | None:
    """Return the kind of that name; other packages are searched only for names that shmmap does not have."""
    return _own.get(name) or _registered.get(name) or _offered().get(name)


def kinds() -> tuple[LayerKind, ...]:
    """Return all kinds, shmmap's own first."""
    return (*_own.values(), *_registered.values(), *_offered().values())


MAX_SPEC_CHARACTERS: Final = 200
MAX_CHAIN: Final = 4

_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)|(?P<name>[A-Za-z_]\w*)|(?P<sign>[(),=]))"
)


@dataclass(frozen=True, slots=True)
class LayerSpec:
    """One layer: its kind, its parameters with a value, and the layer it is built of (None: the source)."""

    kind: LayerKind
    values: tuple[tuple[str, Value], ...]
    of: LayerSpec | None = None

    @property
    def parameters(self) -> dict[str, Value]:
        """The parameters by name."""
        return dict(self.values)

    @property
    def halo_m(self) -> float:
        """Distance beyond the cell from which points are used, metres, including layers it is built of."""
        return self.kind.halo_m(self.parameters) + (self.of.halo_m if self.of is not None else 0.0)

    @property
    def builder_version(self) -> int:
        """Builder versions of this layer (lowest byte) and of the layers it is built of, one byte each."""
        return self.kind.builder_version | (self.of.builder_version << 8 if self.of is not None else 0)

    @property
    def source_columns(self) -> tuple[str, ...] | None:
        """Columns of the source that this layer and the layers it is built of read; None for all."""
        return self.of.source_columns if self.of is not None else self.kind.needs

    def __str__(self) -> str:
        defaults = {p.name: p.default for p in self.kind.parameters}
        words = [f"{name}={value!r}" for name, value in self.values if value != defaults[name]]
        if self.of is not None:
            words.append(f"of={self.of}")
        return f"{self.kind.name}({','.join(words)})" if words else self.kind.name


class _Words:
    """Tokens of a spec, with a look-ahead of one."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens = list(self._split())
        self._at = 0

    def _split(self) -> Iterator[tuple[str, str]]:
        at, end = 0, len(self._text.rstrip())
        while at < end:
            match = _TOKEN.match(self._text, at, end)
            if match is None:
                raise self.refusal(f"unexpected {self._text[at:].strip()[:1]!r}")
            kind = match.lastgroup or "sign"
            yield kind, match.group(kind)
            at = match.end()
        yield "end", ""

    def refusal(self, why: str) -> BadRequest:
        return BadRequest(
            f"layer {self._text!r}: {why}", hint="a layer is written like voxel(leaf=0.5) or points"
        )

    def peek(self) -> tuple[str, str]:
        return self._tokens[self._at]

    def take(self, kind: str, value: str | None = None) -> str | None:
        """Consume and return the next token if it matches, else return None."""
        found, text = self._tokens[self._at]
        if found != kind or (value is not None and text != value):
            return None
        self._at += 1
        return text

    def need(self, kind: str, value: str | None = None) -> str:
        text = self.take(kind, value)
        if text is None:
            found = self.peek()[1]
            raise self.refusal(
                f"expected {value or f'a {kind}'} before {found!r}" if found else "it is cut short"
            )
        return text


def parse_layer(text: str) -> LayerSpec:
    """Read a layer spec.

    Raises
    ------
    BadRequest
        The kind or a parameter is unknown (the hint lists those that exist), a value is out of range,
        or the text is not a spec.
    """
    if len(text) > MAX_SPEC_CHARACTERS:
        raise BadRequest(f"a layer spec has at most {MAX_SPEC_CHARACTERS} characters")
    words = _Words(text)
    spec = _spec(words, 1)
    if words.peek()[0] != "end":
        raise words.refusal(f"unexpected {words.peek()[1]!r} after its end")
    if len(str(spec)) > MAX_SPEC_CHARACTERS:
        raise BadRequest(f"a layer spec has at most {MAX_SPEC_CHARACTERS} characters")
    return spec


def _spec(words: _Words, depth: int) -> LayerSpec:
    if depth > MAX_CHAIN:
        raise words.refusal(f"more than {MAX_CHAIN} layers of one another")
    name = words.need("name")
    kind = find_kind(name)
    if kind is None:
        near = difflib.get_close_matches(name, [known.name for known in kinds()], n=1)
        suggestion = f"did you mean {near[0]!r}?  " if near else ""
        known = ", ".join(known.describe() for known in kinds())
        raise BadRequest(f"unknown layer {name!r}", hint=f"{suggestion}layers are: {known}")
    given: dict[str, Value] = {}
    of: LayerSpec | None = None
    if words.take("sign", "("):
        while not words.take("sign", ")"):
            if given or of is not None:
                words.need("sign", ",")
            number = words.take("number")
            if number is not None:
                if len(given) >= len(kind.parameters) or of is not None:
                    raise BadRequest(f"{name}: too many parameters", hint=_hint(kind))
                key, value = kind.parameters[len(given)].name, _number(number)
            else:
                key = words.need("name")
                words.need("sign", "=")
                if key == "of":
                    if of is not None:
                        raise BadRequest(f"{name}: of is given twice", hint=_hint(kind))
                    of = _source(words, kind, depth)
                    continue
                value = _number(words.need("number"))
            if key in given:
                raise BadRequest(f"{name}: {key} is given twice", hint=_hint(kind))
            given[key] = value
    return _checked(kind, given, of if of is not None and of.kind.name != "points" else None)


def _source(words: _Words, kind: LayerKind, depth: int) -> LayerSpec:
    of = _spec(words, depth + 1)
    if not kind.takes_layers:  # e.g. kinds with a halo, which would need the neighbours' layers, too
        raise BadRequest(f"{kind.name} is built of the source, not of another layer")
    if not of.kind.gives_points:
        raise BadRequest(f"{kind.name} cannot be built of {of.kind.name}, which has no points")
    return of


def _number(text: str) -> Value:
    return int(text) if text.lstrip("+-").isdigit() else float(text)


def _hint(kind: LayerKind) -> str:
    return "; ".join(p.describe() for p in kind.parameters) or f"{kind.name} takes no parameters"


def _checked(kind: LayerKind, given: dict[str, Value], of: LayerSpec | None) -> LayerSpec:
    known = {p.name: p for p in kind.parameters}
    for key in given:
        if key not in known:
            raise BadRequest(f"{kind.name} has no parameter {key!r}", hint=_hint(kind))
    values: dict[str, Value] = {}
    for parameter in kind.parameters:
        if parameter.name in given:
            values[parameter.name] = parameter.checked(given[parameter.name], kind.name)
        elif parameter.required:
            raise BadRequest(f"{kind.name} needs {parameter.name}", hint=_hint(kind))
        elif parameter.default is not None:
            values[parameter.name] = parameter.default
    resolved = kind.resolve(values)
    ordered = tuple((name, resolved[name]) for name in known if name in resolved)
    return LayerSpec(kind, ordered, of)


@lru_cache(maxsize=1024)  # requests repeat a few specs
def canonical_layer(spec: str) -> str:
    """Return the canonical form of a layer spec; errors are those of `parse_layer`."""
    return str(parse_layer(spec))


@lru_cache(maxsize=1024)
def layer_spec(canonical: str) -> LayerSpec:
    """Return the spec of a canonical form; results are cached."""
    return parse_layer(canonical)


def canonical_layers(specs: Sequence[str]) -> tuple[str, ...]:
    """Return the canonical forms of one or more layer specs, without duplicates."""
    if not specs:
        raise BadRequest("a request must name at least one layer")
    return tuple(dict.fromkeys(map(canonical_layer, specs)))
