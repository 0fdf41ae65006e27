# SPDX-License-Identifier: Apache-2.0
"""What child processes inherit: everything but the settings of somebody's real daemon."""

from __future__ import annotations

import os
from collections.abc import Mapping

__all__ = ["without_settings"]


def without_settings(environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the variables without ``SHMMAP_*``, those of tests (``SHMMAP_TEST_*``) excepted."""
    return {
        name: value
        for name, value in environ.items()
        if not name.startswith("SHMMAP_") or name.startswith("SHMMAP_TEST_")
    }
