# SPDX-License-Identifier: Apache-2.0
"""Segments: their bytes (``LAYOUT.md``), their names, and which processes use them."""
