# SPDX-License-Identifier: Apache-2.0
"""Programs that consume a map served by shmmap."""
