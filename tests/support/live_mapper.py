# SPDX-License-Identifier: Apache-2.0
"""A mapper that may be killed at any time: it begins again with the scan that it had no answer for.

    python -m tests.support.live_mapper ENDPOINT FIRST LAST

It sends the scans of `tests.support.live_drive` in rounds, the N-th under the number N whichever process
sent it before, and prints ``applied N`` for each, in the end ``done``: then all of them are durable.
"""

from __future__ import annotations

import sys

from shmmap.chunks.marks import Marks, encode_marks
from shmmap.client.live.mapper import _Marked, _Sender
from tests.support.live_drive import SCANS, drive, marked

TIMEOUT_S = 120.0


def marks_of(number: int, all_marks: list[Marks]) -> Marks:
    """What the scan of a number marks."""
    return all_marks[(number - 1) % SCANS]


def main() -> None:
    """Send scans, one after the other."""
    endpoint, first, last = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    all_marks, poses = marked(), [pose for _, pose in drive()]
    sender = _Sender(endpoint, "lidar", "front", "", TIMEOUT_S, TIMEOUT_S, resume=False)
    opened = sender.opened
    for number in range(first, last + 1):
        data = encode_marks(marks_of(number, all_marks), opened.map_id, opened.mapper, number)
        x, y, z = poses[(number - 1) % SCANS][:3, 3].tolist()
        sender.put(_Marked(number, data, (x, y, z)))
        with sender.changed:
            sender.changed.wait_for(lambda: sender.applied == number or sender.error is not None)  # noqa: B023
        if sender.error is not None:
            raise sender.error
        print(f"applied {number}", flush=True)
    sender.save(TIMEOUT_S)
    print("done", flush=True)
    sender.end()


if __name__ == "__main__":
    main()
