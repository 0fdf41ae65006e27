# SPDX-License-Identifier: Apache-2.0
"""Which layers a request may name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from shmmap.errors import BadRequest

__all__ = ["LAYERS", "canonical_layer", "canonical_layers"]

LAYERS: Final = ("points",)


def canonical_layer(spec: str) -> str:
    """Return the canonical form of a layer spec; `BadRequest` lists what exists for an unknown one."""
    name = spec.strip()
    if name not in LAYERS:
        raise BadRequest(f"unknown layer {spec!r}", hint=f"layers are: {', '.join(LAYERS)}")
    return name


def canonical_layers(specs: Sequence[str]) -> tuple[str, ...]:
    """Return the canonical forms of several layer specs, duplicates left out; there must be one."""
    if not specs:
        raise BadRequest("a request must name at least one layer")
    return tuple(dict.fromkeys(map(canonical_layer, specs)))
