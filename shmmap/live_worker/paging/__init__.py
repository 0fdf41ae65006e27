# SPDX-License-Identifier: Apache-2.0
"""Decide which chunks of a live map are in memory; `shmmap.live_worker.paged_map` carries that out."""
