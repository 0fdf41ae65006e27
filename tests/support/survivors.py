# SPDX-License-Identifier: Apache-2.0
"""Ends what a run of the tests started when that run itself was ended: by a faulthandler timeout, by SIGKILL.

Whatever a test starts carries the run's mark in its environment.  As a program:
``python -m tests.support.survivors MARK`` reads until its input ends, which it does with the run, and
kills everything that carries MARK.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Final

import pytest

from tests.support.daemon_process import ROOT, processes_marked, wait_ended
from tests.support.forked_verbs import forking

__all__ = ["no_survivors"]

_VARIABLE: Final = "PYTEST_RUN_OF_SHMMAP"  # what begins with SHMMAP_ is kept from many a program


@pytest.fixture(scope="session", autouse=True)
def no_survivors() -> Iterator[None]:
    """Mark what this run starts, and have it killed as soon as this process is gone."""
    mark = secrets.token_hex(8)
    watcher = subprocess.Popen(
        [sys.executable, "-m", "tests.support.survivors", mark],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is not for it
    )
    with pytest.MonkeyPatch.context() as patch, forking():
        patch.setenv(_VARIABLE, mark)
        yield
    watcher.kill()
    watcher.communicate()


def main() -> None:
    """Wait for the end of the run, then kill what is left of it."""
    mark = sys.argv[1]
    sys.stdin.read()
    while left := processes_marked(mark, _VARIABLE):
        for pid in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            wait_ended(pid)


if __name__ == "__main__":
    main()
