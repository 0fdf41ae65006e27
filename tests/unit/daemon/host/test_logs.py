# SPDX-License-Identifier: Apache-2.0
"""What goes to the log, and when defects are too many to go on."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Iterator
from typing import cast

import pytest

from shmmap.daemon.host.logs import MAX_DEFECTS, WITHIN_S, Defects, set_up_logging
from shmmap.statistics.writer import StatisticsWriter


@pytest.fixture
def root_logger() -> Iterator[logging.Logger]:
    """Give the root logger its handlers back after the test."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield root
    root.handlers[:], root.level = handlers, level


def test_on_a_terminal(
    root_logger: logging.Logger, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    set_up_logging()
    logging.getLogger("shmmap.x").info("cell %s", "a\x1b[2J.pcd")
    logging.getLogger("shmmap.x").debug("not shown")
    logging.getLogger("shmmap.x").error("bad")
    out, err = capsys.readouterr()
    first, second = err.splitlines()
    assert out == ""
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d INFO    cell a\\x1b\[2J\.pcd", first)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ERROR   bad", second)


def test_under_systemd(
    root_logger: logging.Logger, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every line has its priority, those of a traceback too."""
    monkeypatch.setenv("JOURNAL_STREAM", "8:12345")
    set_up_logging(logging.DEBUG)
    log = logging.getLogger("shmmap.y")
    for level in (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR, logging.CRITICAL):
        log.log(level, "text")
    try:
        raise ValueError("no\x1b[2J")
    except ValueError:
        log.exception("two\nlines")
    lines = capsys.readouterr().err.splitlines()
    assert lines[:6] == [*(f"<{n}>text" for n in (7, 6, 4, 3, 2)), r"<3>two\nlines"]
    assert len(lines) > 7
    assert all(line.startswith("<3>") for line in lines[5:])
    assert lines[-1] == r"<3>ValueError: no\x1b[2J"


class Counts(Counter[str]):
    def add(self, name: str) -> None:
        self[name] += 1


def here(defects: Defects) -> bool:
    try:
        raise RuntimeError("here")
    except RuntimeError:
        return defects.record()


def there(defects: Defects) -> bool:
    try:
        raise RuntimeError("there")
    except RuntimeError:
        return defects.record()


def test_a_hundred_defects_in_ten_seconds_at_one_place(caplog: pytest.LogCaptureFixture) -> None:
    """That many are too many; those of another place, or over a longer time, are not."""
    caplog.set_level(logging.ERROR, "shmmap")
    now_s, counts = 0.0, Counts()
    defects = Defects(cast("StatisticsWriter", counts), lambda: now_s)
    for number in range(3 * MAX_DEFECTS):
        now_s = number * (WITHIN_S / (MAX_DEFECTS - 1) + 0.001)
        assert not here(defects)
    now_s += 2 * WITHIN_S
    assert not any(here(defects) or there(defects) for _ in range(MAX_DEFECTS - 1))
    assert here(defects)
    assert counts == {"defects": 5 * MAX_DEFECTS - 1}
    assert 3 < len(caplog.records) <= 6 + 2
    assert "there" in caplog.text
