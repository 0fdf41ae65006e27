# SPDX-License-Identifier: Apache-2.0
"""Log lines: one event, one line, whatever a file or a client is called; and where they go."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.logfmt import escaped, logfmt, set_up_logging


def test_an_ordinary_line() -> None:
    line = logfmt("evicted", cell="city/20_40.pcd", bytes=1261568, reason="room", after_s=0.25, by=None)
    assert line == "evicted cell=city/20_40.pcd bytes=1261568 reason=room after_s=0.250"
    assert logfmt("load failed", stale=True) == "load failed stale=true"
    assert logfmt("stopping") == "stopping"


@pytest.mark.parametrize(
    ("value", "written"),
    [
        ("", '""'),
        ("north gate.pcd", '"north gate.pcd"'),
        ("a=b", '"a=b"'),
        ('say "no"', r'"say \"no\""'),
        ("C:\\x", r'"C:\\x"'),
        ("a\nb\tc\r", r'"a\nb\tc\r"'),
        ("\x1b[2J\x07", r'"\x1b[2J\x07"'),
        ("\u202egpj", r'"\u202egpj"'),
        ("\U000e0001", r'"\U000e0001"'),
        (os.fsdecode(b"caf\xe9"), r'"caf\udce9"'),
        ("straße.pcd", "straße.pcd"),
    ],
)
def test_other_people_s_words(value: str, written: str) -> None:
    assert logfmt("x", name=value) == f"x name={written}"


@given(st.text())
def test_nothing_moves_the_cursor_or_begins_a_line(text: str) -> None:
    assert escaped(text).isprintable()
    line = logfmt("x", name=text)
    assert line.isprintable()
    assert line.encode()  # lone surrogates are escaped, too


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


def test_a_log_without_a_reader_holds_nothing_up(
    root_logger: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lines are whole or left out, and their number is said."""
    monkeypatch.setenv("JOURNAL_STREAM", "8:12345")
    reading, writing = os.pipe()
    with open(reading, "rb", 0) as reader, open(writing, "w", encoding="utf-8") as stderr:
        monkeypatch.setattr("sys.stderr", stderr)
        set_up_logging()
        log = logging.getLogger("shmmap.z")
        for number in range(1000):
            log.info("line %d %s", number, "x" * 2500)
        lines = [part for part in os.read(reading, 1 << 20).decode().split("\n") if part]
        log.info("read again")
        for number in range(3):
            log.info("line %d", number)
        stderr.close()
        after = reader.read().decode().splitlines()
    assert 10 < len(lines) < 100
    for number, line in enumerate(lines[:-1]):
        assert line == f"<6>line {number} " + "x" * 2500
    whole = len(lines) - (len(lines[-1]) < 2500)
    assert after[-5:] == [
        f'<4>log lines left out: nothing read them count={1000 - whole}',
        "<6>read again", "<6>line 0", "<6>line 1", "<6>line 2",
    ]  # fmt: skip
