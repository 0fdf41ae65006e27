# SPDX-License-Identifier: Apache-2.0
"""What of a live map is in memory: decided here, done by `shmmap.daemon.live.paged_map`."""
