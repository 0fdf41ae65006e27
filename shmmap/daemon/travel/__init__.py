# SPDX-License-Identifier: Apache-2.0
"""Where clients are, how they move, and when they will need which part of the map; without any I/O."""
