# SPDX-License-Identifier: Apache-2.0
"""Absent cells: what is wanted, what is being loaded, by whom, and what an earlier life left."""
