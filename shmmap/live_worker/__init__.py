# SPDX-License-Identifier: Apache-2.0
"""The process that keeps live maps; only this process writes chunks and their files."""
