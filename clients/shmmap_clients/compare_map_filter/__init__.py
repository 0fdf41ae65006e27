# SPDX-License-Identifier: Apache-2.0
"""Removes the points of a live scan that the map explains, and keeps moving objects."""

from __future__ import annotations

from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from shmmap_clients.compare_map_filter.filter import CompareMapFilter, Comparison
    from shmmap_clients.compare_map_filter.rule import CompareRule

__all__ = [
    "CompareMapFilter",
    "CompareRule",
    "Comparison",
]

__getattr__ = lazy_names(__name__)
