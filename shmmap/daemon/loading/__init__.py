# SPDX-License-Identifier: Apache-2.0
"""Loading of absent cells: queue, loader processes, prefetching, adoption of a previous run's segments."""
