# SPDX-License-Identifier: Apache-2.0
"""Present cells: what is in memory, what it costs, and what is evicted."""
