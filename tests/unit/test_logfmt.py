# SPDX-License-Identifier: Apache-2.0
"""Log lines: one event, one line, whatever a file or a client is called."""

from __future__ import annotations

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.logfmt import escaped, logfmt


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
