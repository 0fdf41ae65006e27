# SPDX-License-Identifier: Apache-2.0
"""Live maps: chunks that are written while others read them, kept in memory and on disk."""
