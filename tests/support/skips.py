# SPDX-License-Identifier: Apache-2.0
"""Hooks that say at the end what was skipped and why, and fail a run that skipped what is not on a list.

The latter where ``SHMMAP_TEST_ALLOWED_SKIPS`` names that list: one pattern a line (``*`` and ``?`` as in a
shell) for the test's id, then blanks and why it may be skipped; ``#`` starts a comment.
Any other account may skip what needs root: it is marked so, and `.ci/run` runs exactly that as root.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

import pytest

NEEDS_ROOT: Final = "needs root (other user accounts, private tmpfs)"

_skipped: dict[str, str] = {}


def allowed_patterns(text: str) -> list[str]:
    """Return the patterns of a list."""
    lines = (line.strip() for line in text.splitlines())
    return [line.split(maxsplit=1)[0] for line in lines if line and not line.startswith("#")]


def _note(report: pytest.TestReport | pytest.CollectReport) -> None:
    # an expected failure reports itself as skipped, too
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        _skipped[report.nodeid] = reason


def _unexpected() -> dict[str, str]:
    named = os.environ.get("SHMMAP_TEST_ALLOWED_SKIPS", "")
    if not named:
        return {}
    patterns = allowed_patterns(Path(named).read_text(encoding="utf-8"))
    return {
        test: reason
        for test, reason in _skipped.items()
        if not reason.endswith(NEEDS_ROOT) and not any(fnmatchcase(test, pattern) for pattern in patterns)
    }


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note a skipped test."""
    _note(report)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Note a skipped module."""
    _note(report)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Fail a run that would have passed."""
    if exitstatus == pytest.ExitCode.OK and _unexpected():
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say in one line what was skipped, and which tests should not have been."""
    if reasons := Counter(reason.removeprefix("Skipped: ") for reason in _skipped.values()):
        words = "; ".join(f"{count}: {reason}" for reason, count in reasons.most_common())
        terminalreporter.write_line(f"{reasons.total()} skipped. {words}")
    unexpected = _unexpected()
    if unexpected:
        terminalreporter.section("skipped, but not on the list of allowed skips", red=True)
        for test, reason in unexpected.items():
            terminalreporter.write_line(f"{test}: {reason}")


# -- what a test needs and a machine may lack


def programs_or_skip(*names: str) -> None:
    """Skip the test where one of these programs is missing."""
    for name in names:
        if shutil.which(name) is None:
            pytest.skip(f"{name} is missing")


def open3d_or_skip() -> Any:
    """Return Open3D's module; skip the test where it cannot be loaded."""
    from shmmap.open3d_loading import SYSTEM_PACKAGES

    reason = f"Open3D, or one of {' '.join(SYSTEM_PACKAGES)} that it needs, is missing"
    return pytest.importorskip("open3d", reason=reason, exc_type=ImportError)


@contextlib.contextmanager
def index_or_skip() -> Iterator[None]:
    """Run what has pip build this tree; the test is skipped where pip reaches no package index."""
    try:
        yield
    except AssertionError as error:
        if "satisfies the requirement hatchling" in str(error):
            pytest.skip("pip cannot reach hatchling, which builds the wheel")
        raise
