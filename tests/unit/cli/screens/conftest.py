# SPDX-License-Identifier: Apache-2.0
"""A terminal that keeps what is written to it."""

from __future__ import annotations

import io

import pytest


class Terminal(io.StringIO):
    """A stream that says that it is a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Return a terminal with colours; a test makes it its stdout, which pytest replaces before each test."""
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.delenv("NO_COLOR", raising=False)
    return Terminal()
