# SPDX-License-Identifier: Apache-2.0
"""Which of a window's layers a program means: they may be named as asked for, or as cells are named."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from shmmap.errors import BadRequest

__all__ = ["layer_name"]


def layer_name(layer: str, asked: Sequence[str], present: Collection[str]) -> str:
    """Return the name that the cells of a layer go by, in whatever form it is named.

    Parameters
    ----------
    layer
        As it was asked for, or as `Cell.layer` names it.
    asked
        The window's layers as they were asked for.
    present
        Layers of the cells that are there, in canonical form.

    Raises
    ------
    BadRequest
        The window has no such layer.
    """
    if layer in present:
        return layer
    kind = _kind(layer)
    alike = [one for one in asked if _kind(one) == kind]
    if len(alike) > 1:
        return layer  # parameters tell them apart; only the canonical form does so by itself
    there = next((name for name in present if _kind(name) == kind), None)
    if layer in alike:
        return there or layer
    if there or not alike:
        names = ", ".join([*present] or asked)
        raise BadRequest(f"the window has no layer {layer!r}", hint=f"it has {names}")
    return layer


def _kind(layer: str) -> str:
    return layer.partition("(")[0].strip()
