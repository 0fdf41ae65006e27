# SPDX-License-Identifier: Apache-2.0
"""Generate a town, and simulate a LiDAR that drives through it."""
