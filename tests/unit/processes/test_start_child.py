# SPDX-License-Identifier: Apache-2.0
"""A child process, from its first instruction on."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest

from shmmap.processes.start_child import start_child


@pytest.mark.parametrize("new_session", [False, True])
def test_ctrl_c_cannot_end_a_child_in_its_imports(new_session: bool) -> None:
    process, channel = start_child("shmmap.prepare.worker", "/nowhere", "0", new_session=new_session)
    try:
        status = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
    finally:
        channel.close()
        process.kill()
        process.wait()
    found = re.search(r"^SigBlk:\s*([0-9a-f]+)$", status, re.MULTILINE)
    assert found is not None
    assert int(found[1], 16) & 1 << signal.SIGINT - 1
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ()), "the parent hears it"
