# SPDX-License-Identifier: Apache-2.0
"""Fuzzing in child processes of thirty seconds each: a crash is a finding, and its input stays."""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

__all__ = ["fuzz_in_children", "print_outcomes"]

_CHILD_S: Final = 30.0


def print_outcomes(seed: int, count: int, slowest_s: float, outcomes: Mapping[str, int]) -> None:
    """Print what a child did."""
    table = " ".join(f"{name}={number}" for name, number in sorted(outcomes.items()))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"seed {seed}: {count} inputs, slowest {slowest_s * 1e3:.0f} ms, peak {peak:.0f} MB: {table}")


def fuzz_in_children(name: str, docstring: str | None, child: Callable[[Path, int, float], int]) -> int:
    """Be the program ``tests.benchmarks.NAME``; returns its exit code, 1 for a finding.

    Parameters
    ----------
    name, docstring
        The benchmark's.
    child
        Fuzzes in a directory, from a seed, for some seconds; what it leaves there led to the finding.
    """
    parser = argparse.ArgumentParser(description=docstring.splitlines()[0] if docstring else "")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long to fuzz (default 60)")
    parser.add_argument("--seed", type=int, default=None, help="first seed (default: from the clock)")
    parser.add_argument("--child", type=Path, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        try:
            return child(options.child, options.seed, options.seconds)
        except Exception:  # noqa: BLE001  whatever it is, it is a finding
            traceback.print_exc()
            return 1
    seed = time.time_ns() % 10**9 if options.seed is None else options.seed
    deadline = time.monotonic() + options.seconds
    while (left := deadline - time.monotonic()) > 0:
        folder = Path(tempfile.mkdtemp(prefix=f"{name}."))
        command = [sys.executable, "-X", "faulthandler", "-W", "error", "-m", f"tests.benchmarks.{name}"]
        command += ["--child", str(folder), "--seed", str(seed), "--seconds", f"{min(left, _CHILD_S):.3f}"]
        done = subprocess.run(command, check=False, env=os.environ)
        if done.returncode:
            kept = next(folder.iterdir(), folder)
            print(f"FOUND with seed {seed} (exit {done.returncode}): {kept}", flush=True)
            return 1
        shutil.rmtree(folder)
        seed += 1
    return 0
