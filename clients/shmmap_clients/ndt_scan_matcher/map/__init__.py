# SPDX-License-Identifier: Apache-2.0
"""The matcher's map: voxels of the cells around the vehicle."""
