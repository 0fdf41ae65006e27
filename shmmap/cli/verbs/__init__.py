# SPDX-License-Identifier: Apache-2.0
"""The verbs, in the groups of ``shmmap --help``."""
