# SPDX-License-Identifier: Apache-2.0
"""Divide clouds of any size into maps of square cells, and merge them back."""
