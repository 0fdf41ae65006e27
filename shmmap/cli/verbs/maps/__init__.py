# SPDX-License-Identifier: Apache-2.0
"""Verbs that make, prepare and publish maps."""
