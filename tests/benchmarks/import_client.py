# SPDX-License-Identifier: Apache-2.0
"""What importing the client costs beyond the four packages it needs, in CPU time.

    python -m tests.benchmarks.import_client [--pairs 40]

Two fresh interpreters take turns: one imports numpy, zmq, posix_ipc and msgspec, the other what
``shmmap.connect`` and ``shmmap.MapWindow`` need.  Of each the user and system time of the whole process
counts, less that of an interpreter that imports nothing.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys

_NOTHING = "pass"
_PACKAGES = "import numpy, zmq, posix_ipc, msgspec"
_CLIENT = "import shmmap; shmmap.connect; shmmap.MapWindow"
_ENVIRONMENT = {
    **{
        name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"
    },  # as installed
    "OPENBLAS_NUM_THREADS": "1",  # numpy's threads, just started, spin as long as the process runs
}


def cpu_ms(code: str) -> float:
    """Run ``code`` in a fresh interpreter; returns its user and system time in milliseconds."""
    arguments = [sys.executable, "-c", code]
    pid = os.posix_spawn(sys.executable, arguments, _ENVIRONMENT)
    _, status, usage = os.wait4(pid, 0)
    if status:
        raise SystemExit(f"{' '.join(arguments)} ended with {os.waitstatus_to_exitcode(status)}")
    return (usage.ru_utime + usage.ru_stime) * 1e3


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=40)
    options = parser.parse_args(argv)
    for code in (_PACKAGES, _CLIENT):  # compiled and in the page cache afterwards
        cpu_ms(code)
    nothing = statistics.median(cpu_ms(_NOTHING) for _ in range(options.pairs))
    pairs = [(cpu_ms(_PACKAGES) - nothing, cpu_ms(_CLIENT) - nothing) for _ in range(options.pairs)]
    packages, client = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratios = sorted(ours / theirs for theirs, ours in pairs)
    print(f"bare interpreter  {nothing:6.1f} ms")
    print(f"four packages     {packages:6.1f} ms")
    print(f"client            {client:6.1f} ms")
    low, high = ratios[len(ratios) // 10], ratios[-1 - len(ratios) // 10]
    print(f"ratio in pairs    {statistics.median(ratios):6.3f}  (p10 {low:.3f}, p90 {high:.3f})")


if __name__ == "__main__":
    main()
