# SPDX-License-Identifier: Apache-2.0
"""What keeps a file from being written is said of that file, and nothing else is."""

from __future__ import annotations

import errno
import os

import pytest

from shmmap.errors import CannotWrite, ConnectionLost, MapDataError, NoAnswer, PackageMissing, ShmmapError
from shmmap.formats.durable_file import writing_errors


@pytest.mark.parametrize(
    "error",
    [
        NoAnswer("no map within 60 s", hint="`shmmap status` says more"),
        ConnectionLost("the daemon ended"),
        MapDataError("no cloud"),
        PackageMissing("no package"),
    ],
)
def test_our_own_errors_go_through(error: ShmmapError) -> None:
    """Also those that are an OSError as well: a daemon that does not answer says nothing about a file."""
    with pytest.raises(type(error)) as caught, writing_errors("out.json"):
        raise error
    assert caught.value is error


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EIO])
def test_what_the_system_refuses_names_the_file(number: int) -> None:
    with pytest.raises(CannotWrite) as caught, writing_errors("out.json"):
        raise OSError(number, os.strerror(number))
    assert caught.value.message == f"cannot write out.json: {os.strerror(number)}"
