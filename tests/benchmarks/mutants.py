# SPDX-License-Identifier: Apache-2.0
"""Whether tests notice when the code is broken: mutants drawn at random, and the tests that catch them.

    python -m tests.benchmarks.mutants [--tree DIR] draw --seed 29ca3b8 --count 60 > mutants.json
    python -m tests.benchmarks.mutants [--tree DIR] run mutants.json [STAGE ...] [--only 3,17]
                                                                     [--together 5] [--results FILE]
    python -m tests.benchmarks.mutants carry mutants.json --from OLD > here.json

A mutant is one change of one place: a bound dropped, a comparison turned, a version not compared, a lock not
taken, an fsync left out, nanoseconds for seconds, an error not raised, a condition turned, a number one
off, a call left out.  The same seed draws the same mutants of the same code.  They are spread over the
packages and, in each, over the kinds.

``run`` copies the tree, breaks the copy, and runs tests there, stage by stage, until the first failure.  Each
mutant is printed with the stage and the test that caught it, or at the end as a survivor.  A stage is words
as pytest takes them.  ``near`` are those three files of the package's unit tests that mention the mutant's
module, class and function most, which catch most mutants in seconds; ``own`` are all of them, ``--all own``
also the slow ones (default: `STAGES`).  Where tests fail at random a mutant counts as caught only if the
first test that failed passes in the copy that is not broken.

``--together N`` spares most of the time where whole stages are run and few mutants are caught: each stage but
``near`` is run once with N mutants in the copy.  What fails then is run with each of them alone, and where
some are caught the stage is run again with the rest.

``--tree`` is another checkout, such as an older one, whose code is broken and whose tests are run.  ``carry``
finds its mutants in this one, where the lines that they change stand as they were, in whatever module; the
others are named and left out.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import functools
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
PACKAGES: Final = (
    "shmmap/daemon/cache",
    "shmmap/daemon/loading",
    "shmmap/daemon/requests",
    "shmmap/live_worker",
    "shmmap/client",
    "shmmap/segment",
    "shmmap/origin",
)
NEAR: Final = "near"
NEAREST: Final = 3
"""Files of tests that stage `near` has."""
OWN: Final = "own"
STAGES: Final = (
    NEAR,
    OWN,
    "tests/unit",
    "tests/model",
    "tests/process",
    "--slow tests/unit tests/model",
    "--slow tests/process",
    "--all tests/cpp tests/clients",
)
"""Tests in the order in which they are tried, the nearest first."""
LIMIT_S: Final = 2400.0
"""A stage that takes longer has caught its mutant: something waits without end."""
MAX_ALONE: Final = 20
"""Failed tests that are run with each mutant of a group alone."""
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


def carry(mutant: Mutant, old: Path, new: Path) -> Mutant | None:
    """Find a mutant of a tree in another one; None if its lines are not there, or in several places.

    Indentation and what surrounds the lines may differ.  Where several modules have them, the one in a module
    of the same name counts.
    """
    text = (old / mutant.path).read_text(encoding="utf-8")
    begin = text.rfind("\n", 0, mutant.at) + 1
    end = text.find("\n", mutant.at + len(mutant.old))
    lines = [line.strip() for line in text[begin:end].split("\n")]
    wanted = re.compile(r"^[ \t]*" + r"\n[ \t]*".join(map(re.escape, lines)) + "$", re.MULTILINE)
    nth = len(re.findall(re.escape(mutant.old.split("\n")[0]), text[begin : mutant.at]))
    found: list[Mutant] = []
    for file in sorted((new / "shmmap").rglob("*.py")):
        other = file.read_text(encoding="utf-8")
        for match in wanted.finditer(other):
            parts = r"\n[ \t]*".join(re.escape(line.strip()) for line in mutant.old.split("\n"))
            places = list(re.finditer(parts, match[0]))
            if len(places) > nth:
                at = match.start() + places[nth].start()
                line = other.count("\n", 0, at) + 1
                path = str(file.relative_to(new))
                found.append(Mutant(mutant.kind, path, line, at, places[nth][0], mutant.new))
    if len(found) > 1:
        found = [one for one in found if Path(one.path).name == Path(mutant.path).name]
    return found[0] if len(found) == 1 else None


def own_files(tree: Path, mutant: Mutant) -> list[Path]:
    """Return the files of the unit tests nearest to a mutant's module; first those that are most about it.

    What is mutated is a module, and in it a class, a function: a file is about it that mentions these names,
    and a name counts the more the fewer files mention it.  The list is empty if there are no such tests.
    """
    source = ast.parse((tree / mutant.path).read_text(encoding="utf-8"))
    names = {Path(mutant.path).stem}
    for node in ast.walk(source):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            last = node.end_lineno or node.lineno
            names |= {node.name} if node.lineno <= mutant.line <= last else set()
    words = {
        file: set(re.findall(r"\w+", f"{file.stem.removeprefix('test_')} {file.read_text(encoding='utf-8')}"))
        for file in sorted((tree / _own_folder(tree, mutant.path)).rglob("test_*.py"))
    }
    about = dict.fromkeys(words, 0.0)
    for name in names:
        mentioning = [file for file in words if name in words[file]]
        for file in mentioning:
            about[file] += 1 / len(mentioning)
    return sorted(words, key=lambda file: -about[file])


def _own_folder(tree: Path, path: str) -> Path:
    """Return the folder of unit tests nearest to a module, from the tree's root."""
    parts = Path(path).parent.parts[1:]
    while parts and not tree.joinpath("tests/unit", *parts).is_dir():
        parts = parts[:-1]
    return Path("tests/unit", *parts)


def _tests_of(stage: str, tree: Path, mutant: Mutant) -> str:
    """Return the words for pytest that a stage means for a mutant."""
    words = stage.split()
    if NEAR in words:
        own = [str(file.relative_to(tree)) for file in own_files(tree, mutant)[:NEAREST]]
    else:
        own = [str(_own_folder(tree, mutant.path))]
    found = []
    for word in words:
        found += ["-n", "0", *own] if word in (NEAR, OWN) else [word]
    return " ".join(found)


def _failures(tree: Path, tests: str, limit_s: float, *words: str) -> list[str]:
    """Run tests; returns the names of those that fail, or why there are none to name."""
    command = [sys.executable, "-m", "pytest", "-q", *words, *tests.split()]
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
            return [f"no end within {limit_s:.0f} s"]
        output.seek(0)
        text = output.read()
    if code in (0, 5):  # 5: no tests there
        return []
    # with all parameters of a test where they are named with spaces
    name = r"^(?:FAILED|ERROR) ([^\s\[]+(?:\[\S*\](?=\s|$))?)"
    found = list(dict.fromkeys(re.findall(name, text, re.MULTILINE)))
    return found or [f"exit code {code}: {text[-200:]!r}"]


def _first_failure(tree: Path, tests: str, limit_s: float, *words: str) -> str:
    """Run tests until one fails; returns its name, or empty."""
    return next(iter(_failures(tree, tests, limit_s, "-x", *words)), "")


@functools.cache
def _fails_anyway(whole: Path, test: str, limit_s: float) -> bool:
    """Return whether a test fails in the copy that is not broken, too."""
    fails = bool(_first_failure(whole, test, limit_s, "-n", "0"))
    if fails:
        print(f"    {test} fails without a mutant, too", flush=True)
    return fails


@contextlib.contextmanager
def _broken(tree: Path, mutants: Sequence[Mutant]) -> Iterator[None]:
    """Apply mutants that do not overlap to a copy, and mend it at the end."""
    original = {path: (tree / path).read_text(encoding="utf-8") for path in {one.path for one in mutants}}
    try:
        for mutant in sorted(mutants, key=lambda one: -one.at):  # the places before it stay
            mutant.apply(tree)
        yield
    finally:
        for path, text in original.items():
            (tree / path).write_text(text, encoding="utf-8")


def _overlap(one: Mutant, other: Mutant) -> bool:
    return one.path == other.path and one.at < other.at + len(other.old) and other.at < one.at + len(one.old)


def _groups(numbers: Sequence[int], mutants: Sequence[Mutant], size: int) -> list[list[int]]:
    """Return groups of at most ``size`` mutants that do not overlap."""
    groups: list[list[int]] = []
    for number in numbers:
        for group in groups:
            if len(group) < size and not any(_overlap(mutants[number], mutants[one]) for one in group):
                group.append(number)
                break
        else:
            groups.append([number])
    return groups


def caught_together(
    group: Sequence[int], mutants: Sequence[Mutant], whole: Path, broken: Path, tests: str, limit_s: float
) -> dict[int, str]:
    """Return what catches each of a group of mutants; those that nothing catches are left out.

    A single one needs only the first test that fails.
    """
    if len(group) == 1:
        with _broken(broken, [mutants[group[0]]]):
            first = _first_failure(broken, tests, limit_s)
        if not first:
            return {}
        if " " in first or not _fails_anyway(whole, first, limit_s):
            return {group[0]: first}
    caught: dict[int, str] = {}
    while rest := [number for number in group if number not in caught]:
        with _broken(broken, [mutants[number] for number in rest]):
            failed = _failures(broken, tests, limit_s)
        named = [name for name in failed if " " not in name]
        if failed and not named and len(rest) > 1:  # it does not end, or nothing can be imported
            for half in (rest[::2], rest[1::2]):
                caught |= caught_together(half, mutants, whole, broken, tests, limit_s)
            return caught
        found = {rest[0]: failed[0]} if failed and not named else {}
        for number in rest if named else ():
            with _broken(broken, [mutants[number]]):
                alone = _first_failure(broken, " ".join(named[:MAX_ALONE]), limit_s, "-n", "0")
            if alone and (" " in alone or not _fails_anyway(whole, alone, limit_s)):
                found[number] = alone
        if not found:
            return caught
        caught |= found
    return caught


def _copy(tree: Path, folder: Path) -> Path:
    ignored = shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache", ".hypothesis")
    return Path(shutil.copytree(tree, folder, ignore=ignored, symlinks=True))


def _run(args: argparse.Namespace) -> None:
    mutants = [Mutant(**one) for one in json.loads(args.mutants.read_text(encoding="utf-8"))]
    only = {int(number) for number in args.only.split(",")} if args.only else set(range(len(mutants)))
    left = sorted(only)
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        whole, broken = _copy(args.tree, Path(folder, "whole")), _copy(args.tree, Path(folder, "broken"))
        for stage in args.stages or STAGES:
            size = 1 if NEAR in stage.split() else args.together
            by_tests = defaultdict[str, list[int]](list)
            for number in left:
                by_tests[_tests_of(stage, whole, mutants[number])].append(number)
            groups = [
                (group, tests)
                for tests, numbers in by_tests.items()
                for group in _groups(numbers, mutants, size)
            ]
            for group, tests in sorted(groups):
                found = caught_together(group, mutants, whole, broken, tests, args.limit)
                for number, by in found.items():
                    _report(number, mutants[number], stage, by, args.results)
                    left.remove(number)
    for number in left:
        _report(number, mutants[number], "", "", args.results)
    print(f"{len(only) - len(left)} of {len(only)} are caught")


def _report(number: int, mutant: Mutant, stage: str, by: str, results: Path | None) -> None:
    print(f"{number:3} {mutant}\n    {f'{stage}: {by}' if by else 'SURVIVES'}", flush=True)
    if results is not None:
        with results.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"number": number, "stage": stage, "by": by}) + "\n")


def main() -> None:
    """Draw mutants, or run tests against them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tree", type=Path, default=ROOT, metavar="DIR", help="checkout (default: this one)")
    verbs = parser.add_subparsers(required=True, dest="verb")
    drawing = verbs.add_parser("draw", help="print mutants as JSON")
    drawing.add_argument("--seed", required=True)
    drawing.add_argument("--count", type=int, default=60)
    running = verbs.add_parser("run", help="run tests against them")
    running.add_argument("mutants", type=Path)
    running.add_argument("stages", nargs="*", metavar="STAGE", help="files and folders for pytest")
    running.add_argument("--only", default="", help="numbers of mutants, with commas")
    running.add_argument("--together", type=int, default=1, metavar="N", help="how many in a stage at once")
    running.add_argument("--limit", type=float, default=LIMIT_S, help="of a stage, seconds")
    running.add_argument("--results", type=Path, help="append a line of JSON for each")
    carrying = verbs.add_parser("carry", help="print mutants of another checkout as they are in this one")
    carrying.add_argument("mutants", type=Path)
    carrying.add_argument("--from", type=Path, required=True, dest="old", metavar="OLD", help="that checkout")
    args = parser.parse_args()
    if args.verb == "carry":
        carried = []
        for number, one in enumerate(json.loads(args.mutants.read_text(encoding="utf-8"))):
            mutant = carry(Mutant(**one), args.old, args.tree)
            if mutant is None:
                print(f"{number:3} is not here: {Mutant(**one)}", file=sys.stderr)
            else:
                carried.append(asdict(mutant))
        print(json.dumps(carried, indent=1))
    elif args.verb == "draw":
        print(json.dumps([asdict(one) for one in draw(args.tree, args.seed, args.count)], indent=1))
    else:
        _run(args)


if __name__ == "__main__":
    main()
