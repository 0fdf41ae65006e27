# SPDX-License-Identifier: Apache-2.0
"""PCD files: ascii, binary and compressed."""
