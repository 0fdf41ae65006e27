# SPDX-License-Identifier: Apache-2.0
"""What a window says of a request that has failed."""

from __future__ import annotations

import errno
from typing import Any, cast

import pytest

from shmmap.client.window.follower import PacedFollower
from shmmap.errors import LimitReached


def test_no_descriptor_for_a_module_is_an_error_that_readers_see() -> None:
    follower = PacedFollower(cast("Any", None), 1.0, 1.0)
    follower._failed(OSError(errno.EMFILE, "too many open files"))
    assert isinstance(follower.error, LimitReached)
    with pytest.raises(OSError, match="another"):
        follower._failed(OSError(errno.EIO, "another"))
