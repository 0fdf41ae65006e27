# SPDX-License-Identifier: Apache-2.0
"""Scans of a LiDAR and the poses that belong to them, from files or from a socket."""
