# SPDX-License-Identifier: Apache-2.0
"""File formats, one each: to columns, and back."""
