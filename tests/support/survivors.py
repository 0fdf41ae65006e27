# SPDX-License-Identifier: Apache-2.0
"""Ends what a run of the tests started when that run itself was ended: by a faulthandler timeout, by SIGKILL.

Whatever a test starts carries the run's mark in its environment, and whatever it forks has the other end of a
pipe: `tests.support.kill_survivors` finds both.
"""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
from collections.abc import Iterator
from typing import Final

import pytest

from tests.support.forked_programs import ROOT, forking

_VARIABLE: Final = "PYTEST_RUN_OF_SHMMAP"  # what begins with SHMMAP_ is kept from many a program


@pytest.fixture(scope="session", autouse=True)
def no_survivors() -> Iterator[None]:
    """Mark what this run starts, and have it killed as soon as this process is gone."""
    mark = secrets.token_hex(8)
    pidfd = os.pidfd_open(os.getpid())
    watcher = subprocess.Popen(
        [sys.executable, "-m", "tests.support.kill_survivors", _VARIABLE, mark, str(pidfd)],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        pass_fds=[pidfd],
        start_new_session=True,  # Ctrl-C is not for it
    )
    os.close(pidfd)
    with pytest.MonkeyPatch.context() as patch, forking():
        patch.setenv(_VARIABLE, mark)
        yield
    watcher.kill()
    watcher.communicate()
