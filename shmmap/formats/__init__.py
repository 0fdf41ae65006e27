# SPDX-License-Identifier: Apache-2.0
"""File formats: each module reads files into columns or writes columns to files."""
