# SPDX-License-Identifier: Apache-2.0
"""Files of a live map: written by the live worker, and checked, exported and reset without a daemon."""
