# SPDX-License-Identifier: Apache-2.0
"""Mutated bytes against what reads bytes of others: connections, the protocol's codec, a segment, PCD.

    python -m tests.benchmarks.fuzz [zmtp protocol segment pcd] [--seconds 60] [--seed N]

Starts from the inputs in ``tests/corpus``.  Each target runs in child processes under a limit of
address space, so that an allocation which the input does not justify is a finding; so is every
exception that is not the reader's own, and every crash.  The input of a finding is written to the
corpus, where ``tests/unit/test_corpus.py`` reads it again with every run of the tests.
(``fuzz_pcd`` knows more about PCD's grammar.)
"""

from __future__ import annotations

import argparse
import hashlib
import random
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from tests.support.daemon_process import ROOT
from tests.support.fuzzing import CORPUS, TARGETS, corpus, limit_memory

ALLOWED_BYTES = 100 << 20
CHILD_S = 30.0


def child(name: str, last_input: Path, seed: int, seconds: float) -> None:
    """Fuzz for a while; what is being tried lies in ``last_input`` when this process dies of it."""
    rng = random.Random(seed)
    target = TARGETS[name]
    pool = list(corpus(name).values())
    limit_memory(ALLOWED_BYTES)
    outcomes: Counter[str] = Counter()
    with last_input.open("r+b", buffering=0) as current:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            data = target.mutate(rng.choice(pool), rng, pool)
            current.seek(0)
            current.truncate()
            current.write(data)
            outcome = target.check(data)
            if outcome not in outcomes and len(pool) < 1000:
                pool.append(data)  # it went somewhere new: a good place to start from
            outcomes[outcome] += 1
    table = " ".join(f"{outcome}={count}" for outcome, count in outcomes.most_common(8))
    print(f"{name}, seed {seed}: {outcomes.total()} inputs, {len(outcomes)} outcomes: {table}", flush=True)


def fuzz(name: str, seed: int, seconds: float) -> int:
    """Run children until the time is over; 1 on the first finding."""
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0:
        with tempfile.NamedTemporaryFile(prefix="fuzz-") as last_input:
            command = [
                sys.executable,
                "-X",
                "faulthandler",
                "-W",
                "error",
                "-m",
                "tests.benchmarks.fuzz",
                name,
            ]
            command += [
                "--child",
                last_input.name,
                "--seed",
                str(seed),
                "--seconds",
                f"{min(left_s, CHILD_S):.3f}",
            ]
            done = subprocess.run(command, check=False, cwd=ROOT)
            if done.returncode:
                data = Path(last_input.name).read_bytes()
                kept = CORPUS / name / f"found-{hashlib.sha256(data).hexdigest()[:12]}"
                kept.write_bytes(data)
                print(f"FOUND with seed {seed} (exit {done.returncode}): {kept}", flush=True)
                return 1
        seed += 1
    return 0


def main() -> int:
    """Parse and run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}; default all")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target (default: 60)")
    parser.add_argument("--seed", type=int, default=None, help="first seed (default: from the clock)")
    parser.add_argument("--child", type=Path, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    unknown = set(options.targets) - TARGETS.keys()
    if unknown:
        parser.error(f"no such target: {', '.join(sorted(unknown))}")
    seed = time.time_ns() % 10**9 if options.seed is None else options.seed
    if options.child is not None:
        try:
            child(options.targets[0], options.child, seed, options.seconds)
        except Exception:
            traceback.print_exc()
            return 1
        return 0
    return max(fuzz(name, seed, options.seconds) for name in options.targets or TARGETS)


if __name__ == "__main__":
    sys.exit(main())
