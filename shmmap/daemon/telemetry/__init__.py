# SPDX-License-Identifier: Apache-2.0
"""Content of the statistics segment."""
