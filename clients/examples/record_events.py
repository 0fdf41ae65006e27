# SPDX-License-Identifier: Apache-2.0
"""Record events of the daemon, as a line of JSON for each.

    python3 record_events.py events.jsonl             # until Ctrl-C
    python3 record_events.py events.jsonl 60          # for a minute

Events are numbered, and the daemon keeps the latest few thousand.  A reader that was slow, or that reconnects
after a restart of the daemon, requests the events that it missed.  Events lost nevertheless are reported.
"""

from __future__ import annotations

import contextlib
import sys
import time

import msgspec

import shmmap


def main() -> int:
    """Append events to the file."""
    path, *seconds = sys.argv[1:]
    end_s = time.monotonic() + float(seconds[0]) if seconds else float("inf")
    with (
        open(path, "ab") as file,
        shmmap.events.EventStream(since=60.0) as events,  # begin with events of the last minute
        contextlib.suppress(KeyboardInterrupt),
    ):
        while (left_s := end_s - time.monotonic()) > 0:
            event = events.next(timeout=min(left_s, 1.0))
            if event is None:
                continue
            if isinstance(event, shmmap.events.MissedEvents):
                print(f"events {event.first} to {event.last} are lost", file=sys.stderr)
                continue
            document = {"kind": event.__struct_config__.tag, **msgspec.structs.asdict(event)}
            file.write(msgspec.json.encode(document) + b"\n")
            file.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
