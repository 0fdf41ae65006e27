# SPDX-License-Identifier: Apache-2.0
"""A cell's source: where its points come from, in the words of the origin that names it."""

from __future__ import annotations

import msgspec

__all__ = ["Source"]


class Source(msgspec.Struct, frozen=True, array_like=True):
    """Where a cell's points come from.

    Attributes
    ----------
    name
        What messages call it; of a file its path, which is all there is to know.
    words
        What the origin that named it says beside, for its own reader (`shmmap.layers.source_reader`) alone.
    """

    name: str
    words: bytes = b""
