# SPDX-License-Identifier: Apache-2.0
"""LiDAR scans and their poses, from files or from a socket."""
