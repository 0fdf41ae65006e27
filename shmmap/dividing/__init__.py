# SPDX-License-Identifier: Apache-2.0
"""Clouds of any size into maps of square cells, and back."""
