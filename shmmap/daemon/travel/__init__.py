# SPDX-License-Identifier: Apache-2.0
"""Positions and motion of clients, and when they need which part of the map; without any I/O."""
