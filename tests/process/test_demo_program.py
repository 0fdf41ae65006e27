# SPDX-License-Identifier: Apache-2.0
"""Programs beside the demonstration: read while they run or in the end, and never left behind."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from shmmap.demo.process_usage import cpu_seconds
from shmmap.demo.program import Program
from shmmap.errors import InternalError
from tests.support.daemon_process import wait_ended


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module ``said`` that runs the code it is given."""
    (tmp_path / "said.py").write_text("import sys\nexec(sys.argv[1])\n", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "said"


def test_what_it_writes_in_the_end(program: str, tmp_path: Path) -> None:
    with Program("one", program, ["print('{\"a\": 1}'); sys.exit(3)"], tmp_path) as one:
        assert json.loads(one.finish(60.0, fails=True)) == {"a": 1}
        assert one.exit_code == 3
        assert not one.running
        with pytest.raises(InternalError, match="one does not run"):
            one.read_line(60.0)
    with (
        Program("other", program, ["raise SystemExit('no map')"], tmp_path) as other,
        pytest.raises(InternalError, match="other ended with 1: no map"),
    ):
        other.finish(60.0)


def test_what_it_writes_meanwhile(program: str, tmp_path: Path) -> None:
    with Program("one", program, ["for n in range(3): print(n, flush=True)"], tmp_path) as one:
        assert [json.loads(line) for line in one.lines(60.0)] == [0, 1, 2]
        with pytest.raises(InternalError, match="one ended early"):
            one.read_line(60.0)


def test_it_answers_lines_and_starts_again(program: str, tmp_path: Path) -> None:
    with Program("one", program, ["for line in sys.stdin: print(line[::-1].strip())"], tmp_path) as one:
        for text in ("map", "cell"):
            one.write_line(text)
            one.end_input()
            assert one.finish(60.0) == text[::-1]
            one.start()


def test_one_that_says_nothing_is_not_waited_for_forever(program: str, tmp_path: Path) -> None:
    words = ["import signal; print('begun', flush=True); signal.pause()"]
    with Program("one", program, words, tmp_path) as one:
        said = one.lines(60.0)
        assert next(said) == "begun"
        with pytest.raises(InternalError, match="one wrote nothing"):
            next(one.lines(0.01))


def test_it_ends_with_all_that_it_has_started(program: str, tmp_path: Path) -> None:
    """It starts a child, says its number, and both would wait forever."""
    code = (
        "import signal, subprocess\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import signal; signal.pause()'])\n"
        "print(child.pid, flush=True); signal.pause()"
    )
    with Program("one", program, [code], tmp_path) as one:
        child = int(next(one.lines(60.0)))
        os.kill(child, 0)
    assert wait_ended(child)
    assert not one.running


def test_processor_time_of_a_process_and_of_its_children_that_ended(program: str, tmp_path: Path) -> None:
    burn = "import time\nwhile time.process_time() < 0.4: pass"
    code = (
        f"import subprocess; subprocess.run([sys.executable, '-c', {burn!r}])\n{burn}\n"
        "print('burnt', flush=True); import signal; signal.pause()"
    )
    with Program("one", program, [code], tmp_path) as one:
        assert next(one.lines(60.0)) == "burnt"
        assert 0.75 <= cpu_seconds([one.pid]) < 60.0
        assert cpu_seconds([one.pid, os.getpid()]) > cpu_seconds([one.pid])
    with pytest.raises((ProcessLookupError, FileNotFoundError)):
        cpu_seconds([2**22 + 1])
