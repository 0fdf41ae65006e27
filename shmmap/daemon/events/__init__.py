# SPDX-License-Identifier: Apache-2.0
"""Numbered events, and their delivery to subscribers."""
