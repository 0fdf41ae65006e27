# SPDX-License-Identifier: Apache-2.0
"""Whether tests notice when the code is broken: mutants drawn at random, and the tests that catch them.

    python -m tests.benchmarks.mutants draw --seed 29ca3b8 --count 60 > mutants.json
    python -m tests.benchmarks.mutants run mutants.json [--only 3,17] [--results FILE] [STAGE ...]

A mutant is one change of one place: a bound dropped, a comparison turned, a version not compared, a lock not
taken, an fsync left out, nanoseconds for seconds, an error not raised, a condition turned, a number one
off, a call left out.  The same seed draws the same mutants of the same code.  They are spread over the
packages and, in each, over the kinds.

``run`` copies the tree, breaks the copy, and runs tests there, stage by stage, until the first failure;
mutant by mutant.  Each is printed with what caught it, or as a survivor.  A stage is a word as pytest takes
them; ``own`` are the unit tests of the package (default: `STAGES`).  Where tests fail at random a mutant
counts as caught only if the first test that failed passes in the copy that is not broken.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

__all__ = ["Mutant", "draw", "mutants_of"]

ROOT: Final = Path(__file__).resolve().parents[2]
PACKAGES: Final = (
    "shmmap/daemon/cache",
    "shmmap/daemon/loading",
    "shmmap/daemon/requests",
    "shmmap/daemon/live",
    "shmmap/client",
    "shmmap/segment",
    "shmmap/origin",
)
OWN: Final = "own"
STAGES: Final = (OWN, "tests/unit", "tests/model", "tests/process", "tests/cpp tests/clients")
"""Tests in the order in which they are tried, the nearest first."""
LIMIT_S: Final = 2400.0
"""A stage that takes longer has caught its mutant: something waits for ever."""
_TURNED: Final = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
_OPERATORS: Final = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
_BILLIONS: Final = ("1e9", "1_000_000_000", "10**9", "1e-9", "1000000000")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: ``new`` in place of ``old``, ``at`` characters into a file."""

    kind: str
    path: str
    line: int
    at: int
    old: str
    new: str

    def apply(self, root: Path) -> None:
        """Break the file of a tree."""
        file = root / self.path
        text = file.read_text(encoding="utf-8")
        assert text[self.at : self.at + len(self.old)] == self.old, f"{self.path} is another one"
        file.write_text(text[: self.at] + self.new + text[self.at + len(self.old) :], encoding="utf-8")

    def __str__(self) -> str:
        old, new = (" ".join(text.split()) for text in (self.old, self.new))
        return f"{self.path}:{self.line} {self.kind}: {old[:70]!r} becomes {new[:70]!r}"


class _Places(ast.NodeVisitor):
    """All mutants of one file."""

    def __init__(self, path: str, text: str) -> None:
        self.found: list[Mutant] = []
        self._path, self._text = path, text
        self._lines = [0]
        for line in text.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        def at(line: int, column: int) -> int:  # columns are counted in bytes
            begin = self._lines[line - 1]
            end = self._lines[line]
            return begin + len(self._text[begin:end].encode()[:column].decode())

        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return at(node.lineno, node.col_offset), at(node.end_lineno, node.end_col_offset)

    def _source(self, node: ast.expr | ast.stmt) -> str:
        begin, end = self._span(node)
        return self._text[begin:end]

    def _add(self, kind: str, node: ast.expr | ast.stmt, new: str) -> None:
        begin, end = self._span(node)
        old = self._text[begin:end]
        if old != new:
            self.found.append(Mutant(kind, self._path, node.lineno, begin, old, new))

    def visit_Compare(self, node: ast.Compare) -> None:
        source = self._source(node)
        if len(node.ops) == 1:
            left, right = self._source(node.left), self._source(node.comparators[0])
            if "version" in source and isinstance(node.ops[0], ast.Eq | ast.NotEq):
                self._add("version not compared", node, str(isinstance(node.ops[0], ast.Eq)))
            elif (operator := _OPERATORS.get(type(node.ops[0]))) is not None:
                self._add("comparison turned", node, f"{left} {_TURNED[operator]} {right}")
            elif isinstance(node.ops[0], ast.Is | ast.IsNot):
                turned = "is not" if isinstance(node.ops[0], ast.Is) else "is"
                self._add("comparison turned", node, f"{left} {turned} {right}")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        name = self._source(node.func)
        if name in ("min", "max") and len(node.args) == 2 and not node.keywords:
            self._add("bound dropped", node, f"({self._source(node.args[0])})")
            self._add("bound dropped", node, f"({self._source(node.args[1])})")
        self.generic_visit(node)

    def visit_With(self, node: ast.With) -> None:
        for item in node.items:
            if re.search(r"(\b|_)lock$", self._source(item.context_expr)):
                self._add("lock not taken", item.context_expr, "__import__('contextlib').nullcontext()")
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call):
            name = self._source(node.value.func)
            kind = "fsync left out" if re.search(r"f(data)?sync", name) else "call left out"
            if not name.startswith(("log.", "super()", "step")):
                self._add(kind, node, "pass")
        self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        if node.exc is not None and not self._source(node).startswith("raise NotImplemented"):
            self._add("error not raised", node, "pass")

    def visit_If(self, node: ast.If) -> None:
        if self._source(node.test) != "TYPE_CHECKING":
            self._add("condition turned", node.test, f"not ({self._source(node.test)})")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for value in node.values:
            if len(node.values) == 2:
                self._add("condition dropped", node, f"({self._source(value)})")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        source = self._source(node)
        if source in _BILLIONS:
            self._add("nanoseconds for seconds", node, "1")
        elif isinstance(node.value, int) and not isinstance(node.value, bool) and "0x" not in source:
            self._add("number one off", node, str(node.value + 1))

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Texts are no code."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for one in [*node.body, *node.args.defaults, *(d for d in node.args.kw_defaults if d is not None)]:
            self.visit(one)  # no annotations, no decorators

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)


def mutants_of(root: Path, package: str) -> list[Mutant]:
    """Return all mutants of a package's modules, in the order of paths and places."""
    found: list[Mutant] = []
    for file in sorted((root / package).rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        places = _Places(str(file.relative_to(root)), text)
        places.visit(ast.parse(text))
        found += sorted(places.found, key=lambda one: (one.at, one.kind, one.new))
    return found


def draw(root: Path, seed: str, count: int) -> list[Mutant]:
    """Return mutants, in turn of each package, there in turn of each kind."""
    chance = random.Random(seed)
    drawn: list[Mutant] = []
    queues = []
    for package in PACKAGES:
        kinds: dict[str, list[Mutant]] = defaultdict(list)
        for mutant in mutants_of(root, package):
            kinds[mutant.kind].append(mutant)
        for some in kinds.values():
            chance.shuffle(some)
        names = sorted(kinds)
        chance.shuffle(names)
        queues.append(_in_turn([kinds[name] for name in names]))
    for mutant in _in_turn(queues):
        if len(drawn) == count:
            break
        drawn.append(mutant)
    return drawn


def _in_turn(queues: Sequence[Sequence[Mutant] | Iterator[Mutant]]) -> Iterator[Mutant]:
    left = [iter(queue) for queue in queues]
    while left:
        for queue in list(left):
            if (mutant := next(queue, None)) is None:
                left.remove(queue)
            else:
                yield mutant


def _own_tests(tree: Path, path: str) -> str:
    """Return the folder of unit tests nearest to a module; empty if it has none."""
    folder = Path(path).parent
    while folder.parts[1:]:
        own = Path("tests/unit", *folder.parts[1:])
        if (tree / own).is_dir():
            return str(own)
        folder = folder.parent
    return ""


def _first_failure(tree: Path, tests: str, limit_s: float, *words: str) -> str:
    """Run tests until one fails; returns its name, or empty."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *words, *tests.split()]
    paths = os.pathsep.join((str(tree), str(tree / "clients")))
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": ""}
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            command, cwd=tree, env=environment, stdout=output, stderr=subprocess.STDOUT, text=True
        )
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return f"no end within {limit_s:.0f} s"
        output.seek(0)
        text = output.read()
    if code in (0, 5):  # 5: no tests there
        return ""
    found = re.search(r"^(?:FAILED|ERROR) (\S+)", text, re.MULTILINE)
    return found[1] if found is not None else f"exit code {code}: {text[-200:]!r}"


def _caught_by(mutant: Mutant, whole: Path, broken: Path, stages: Sequence[str], limit_s: float) -> str:
    """Return what catches a mutant; empty if nothing does."""
    original = (broken / mutant.path).read_text(encoding="utf-8")
    mutant.apply(broken)
    try:
        for stage in stages:
            tests = _own_tests(whole, mutant.path) if stage == OWN else stage
            one_at_a_time = ("-n", "0") if stage == OWN else ()
            failed = _first_failure(broken, tests, limit_s, *one_at_a_time) if tests else ""
            if failed and (" " in failed or not _first_failure(whole, failed, limit_s, "-n", "0")):
                return failed
            if failed:
                print(f"    {failed} fails without it, too", flush=True)
    finally:
        (broken / mutant.path).write_text(original, encoding="utf-8")
    return ""


def _copy(folder: Path) -> Path:
    ignored = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache", ".hypothesis")
    return Path(shutil.copytree(ROOT, folder, ignore=ignored, symlinks=True))


def _run(args: argparse.Namespace) -> None:
    mutants = [Mutant(**one) for one in json.loads(args.mutants.read_text(encoding="utf-8"))]
    only = {int(number) for number in args.only.split(",")} if args.only else set(range(len(mutants)))
    stages = tuple(args.stages) or STAGES
    caught = 0
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        whole, broken = _copy(Path(folder, "whole")), _copy(Path(folder, "broken"))
        for number in sorted(only):
            begin_s = time.monotonic()
            by = _caught_by(mutants[number], whole, broken, stages, args.limit)
            caught += bool(by)
            print(
                f"{number:3} {mutants[number]}\n    {by or 'SURVIVES'}, {time.monotonic() - begin_s:.0f} s",
                flush=True,
            )
            if args.results:
                with args.results.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"number": number, "by": by}) + "\n")
    print(f"{caught} of {len(only)} are caught")


def main() -> None:
    """Draw mutants, or run tests against them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = parser.add_subparsers(required=True, dest="verb")
    drawing = verbs.add_parser("draw", help="print mutants as JSON")
    drawing.add_argument("--seed", required=True)
    drawing.add_argument("--count", type=int, default=60)
    running = verbs.add_parser("run", help="run tests against them")
    running.add_argument("mutants", type=Path)
    running.add_argument("stages", nargs="*", metavar="STAGE", help="files and folders for pytest")
    running.add_argument("--only", default="", help="numbers of mutants, with commas")
    running.add_argument("--limit", type=float, default=LIMIT_S, help="of a stage, seconds")
    running.add_argument("--results", type=Path, help="append a line of JSON for each")
    args = parser.parse_args()
    if args.verb == "draw":
        print(json.dumps([asdict(one) for one in draw(ROOT, args.seed, args.count)], indent=1))
    else:
        _run(args)


if __name__ == "__main__":
    main()
