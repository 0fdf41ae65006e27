# SPDX-License-Identifier: Apache-2.0
"""Origins of a map's cells: map directories, single clouds, published maps."""
