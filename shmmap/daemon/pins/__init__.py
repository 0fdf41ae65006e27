# SPDX-License-Identifier: Apache-2.0
"""Which segments are in use, according to the kernel."""
