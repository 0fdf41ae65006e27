# SPDX-License-Identifier: Apache-2.0
"""Stores of every kind, on this machine."""

from __future__ import annotations

from importlib.util import find_spec

from tests.support.map_stores import _buckets, buckets, web  # noqa: F401  fixtures

if find_spec("zstandard") is None:
    collect_ignore_glob = ["test_*.py"]
