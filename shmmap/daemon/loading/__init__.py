# SPDX-License-Identifier: Apache-2.0
"""Absent cells: what is wanted, what is being loaded and by which loader, and what a previous run left."""
