# SPDX-License-Identifier: Apache-2.0
"""Live maps: maps that are written while they are read.  `shmmap.Client.live` returns one."""
