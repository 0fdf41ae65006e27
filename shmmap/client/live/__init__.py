# SPDX-License-Identifier: Apache-2.0
"""Live maps: a map that is written while it is read.  `shmmap.Client.live` gives one."""
