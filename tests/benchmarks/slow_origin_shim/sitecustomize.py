# SPDX-License-Identifier: Apache-2.0
"""Makes a daemon's loaders as slow as an origin far away; a daemon started with this directory in PYTHONPATH.

``SLOW_ORIGIN`` is JSON: ``mean_s`` (of a log-normal time for each file, sigma 0.8, the same each time),
``throttle_bytes_s`` (0 for none), ``outage_s`` and ``every_s``: for so long after every period nothing
can be read; what begins or lasts in an outage fails.  ``begin`` is a file that says when the first period
begins, in seconds of `time.monotonic`; until it is there, there is no outage.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import random
import time
from pathlib import Path
from typing import Any

SIGMA = 0.8


def _slow_down(plan: dict[str, Any]) -> None:
    from shmmap.daemon.loading import worker_main

    begun_s = math.inf

    def is_out() -> bool:
        nonlocal begun_s
        if begun_s == math.inf:
            with contextlib.suppress(FileNotFoundError, ValueError):
                begun_s = float(Path(plan["begin"]).read_text())
        periods, since_s = divmod(time.monotonic() - begun_s, plan["every_s"])
        return bool(periods >= 1 and since_s < plan["outage_s"])

    def wait_for_origin(path: str) -> None:
        mean_s, bytes_s = plan["mean_s"], plan["throttle_bytes_s"]
        took_s = os.stat(path).st_size / bytes_s if bytes_s else 0.0
        if mean_s:
            took_s += random.Random(path).lognormvariate(math.log(mean_s) - SIGMA**2 / 2, SIGMA)
        end_s = time.monotonic() + took_s
        while not is_out() and (left_s := end_s - time.monotonic()) > 0:
            time.sleep(min(left_s, 0.05))
        if is_out():
            raise OSError(errno.EIO, "the origin does not answer", path)

    worker_main._test_hook = wait_for_origin


if "SLOW_ORIGIN" in os.environ:
    _slow_down(json.loads(os.environ["SLOW_ORIGIN"]))
