# SPDX-License-Identifier: Apache-2.0
"""Detection of segments in use, by queries to the kernel."""
