# SPDX-License-Identifier: Apache-2.0
"""Computes a map's layers ahead of time, into the disk cache that the daemon reads."""
