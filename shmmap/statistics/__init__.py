# SPDX-License-Identifier: Apache-2.0
"""What the daemon tells about itself without being asked: counters and resident cells in shared memory."""
