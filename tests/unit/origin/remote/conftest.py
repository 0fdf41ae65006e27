# SPDX-License-Identifier: Apache-2.0
"""Stores of every kind, on this machine."""

from tests.support.map_stores import _buckets, buckets, web  # noqa: F401  fixtures
