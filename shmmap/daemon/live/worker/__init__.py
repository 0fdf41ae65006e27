# SPDX-License-Identifier: Apache-2.0
"""The process that keeps live maps: it alone writes chunks and their files."""
