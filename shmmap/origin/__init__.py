# SPDX-License-Identifier: Apache-2.0
"""Where cells come from: map directories, single clouds, published maps."""
