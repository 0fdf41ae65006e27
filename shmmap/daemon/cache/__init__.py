# SPDX-License-Identifier: Apache-2.0
"""Cells in memory: their accounting, use and eviction."""
