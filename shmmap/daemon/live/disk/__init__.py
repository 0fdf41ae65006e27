# SPDX-License-Identifier: Apache-2.0
"""What a live map is on the disk, and what can be done with it there without a daemon."""
