# SPDX-License-Identifier: Apache-2.0
"""A generated town, and a simulated LiDAR that drives through it."""
