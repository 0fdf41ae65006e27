# SPDX-License-Identifier: Apache-2.0
"""Removes from a live scan what the map explains, and leaves what moved."""

from shmmap_clients.compare_map_filter.filter import CompareMapFilter as CompareMapFilter
from shmmap_clients.compare_map_filter.filter import Comparison as Comparison
from shmmap_clients.compare_map_filter.rule import CompareRule as CompareRule

__all__ = ["CompareMapFilter", "CompareRule", "Comparison"]
