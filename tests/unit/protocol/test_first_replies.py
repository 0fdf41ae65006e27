# SPDX-License-Identifier: Apache-2.0
"""Threads that decode their first replies at once: msgspec's decoders must not be made by two of them."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys, threading
from shmmap.protocol import messages as m
from shmmap.protocol.codec import decode_reply, encode
handle = m.Handle("a", 1, "points", "00", 0, 8192, 9, 0.0, 0.0, 20.0, 20.0)
data = encode(m.Cells(1, 2, 3, cells=(handle,)))
sys.setswitchinterval(1e-6)
start = threading.Barrier(8)
def work():
    start.wait()
    assert decode_reply(data).cells == (handle,)
threads = [threading.Thread(target=work) for _ in range(8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""


def test_first_replies_in_many_threads() -> None:
    for _ in range(12):
        done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
