# SPDX-License-Identifier: Apache-2.0
"""User accounts that need not exist: numbers are enough for the kernel."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support.daemon_process import ROOT

DAEMON_UID, GROUP, MEMBER, STRANGER, ADMINS = 61001, 61002, 61003, 61004, 61005


def as_user(uid: int, gid: int, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command as somebody else, without any other group."""
    return subprocess.run(
        ["setpriv", f"--reuid={uid}", f"--regid={gid}", "--clear-groups", "--inh-caps=-all", *command],
        capture_output=True,
        text=True,
        cwd="/",
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT)},
    )


def python_for_others() -> str:
    """Path of a Python that other accounts can start; the test is skipped where there is none."""
    own = os.path.realpath(sys.executable)  # the environment itself may not be open to others
    for python in (own, "/usr/bin/python3"):
        if (
            os.path.exists(python)
            and not as_user(STRANGER, STRANGER, python, "-I", "-c", "import json").returncode
        ):
            return python
    pytest.skip("this Python cannot be started by other accounts")
