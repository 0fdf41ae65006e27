# SPDX-License-Identifier: Apache-2.0
"""Scripts that complete the command line are what the parser has now, and complete it in a real shell.

After a change of verbs or options, ``python -m tests.unit.cli.test_completion`` writes them again.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from shmmap.cli.entry import VERBS, build_parser
from shmmap.cli.verbs.run.completion import SHELLS, script_of
from tests.support.daemon_process import ROOT
from tests.support.pages import read_page, write_program
from tests.unit.conftest import Verb

COMPLETION = read_page("shmmap/INSTALL.md").commands("completion")
DIRECTORIES = {"DIR", "KEYDIR"}
FILES = {"FILE", "FILE.png", "IN", "MAP", "OUT", "PATH", "ROOT.json"}


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for choice in action._choices_actions:
                action.choices[choice.dest].description = choice.help  # shells show a line
            for below in action.choices.values():
                yield from _actions(below)


def generated(shell: str) -> str:
    """Return the script that the parser has now."""
    import shtab

    parser = build_parser()
    for action in list(_actions(parser)):
        names = action.metavar if isinstance(action.metavar, str) else ""
        if names in DIRECTORIES:
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
        elif names in FILES:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    text: str = shtab.complete(parser, shell)
    head = "" if shell == "zsh" else "# SPDX-License-Identifier: Apache-2.0\n"  # zsh: #compdef comes first
    lines = [line.rstrip() for line in text.splitlines()]
    return head + "\n".join(lines) + "\n"


@pytest.mark.parametrize("shell", SHELLS)
def test_the_scripts_are_those_of_the_parser(shell: str) -> None:
    pytest.importorskip("shtab", reason="shtab, of the extra dev, is not installed")
    assert script_of(shell).read_text(encoding="utf-8") == generated(shell)


@pytest.mark.parametrize("shell", SHELLS)
def test_the_verb_prints_the_script_with_every_verb(shell: str, verb: Verb) -> None:
    text = verb(["completion", shell]).out
    assert text == script_of(shell).read_text(encoding="utf-8")
    for name in VERBS:
        assert re.search(rf"\b{name}\b", text), name


def completed(*words: str) -> list[str]:
    """Return what bash offers for the last of the words."""
    function = re.search(r"complete .*-F (\w+) shmmap", script_of("bash").read_text(encoding="utf-8"))
    assert function is not None
    script = script_of("bash")
    line, last = " ".join(words), len(words) - 1
    program = (
        f'source "{script}"; COMP_WORDS=({line}); COMP_CWORD={last}; COMP_LINE="{line}"\n'
        f'COMP_POINT=${{#COMP_LINE}}; {function[1]}; printf "%s\\n" "${{COMPREPLY[@]}}"'
    )
    done = subprocess.run(
        ["bash", "--norc", "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_verbs_and_options() -> None:
    assert {"status", "stop"} & set(completed("shmmap", "st")) == {"status", "stop"}
    assert completed("shmmap", "completion", "f") == ["fish"]
    assert "--prepare" in completed("shmmap", "serve", "--pre")


@pytest.mark.parametrize("shell", SHELLS)
def test_the_line_of_a_start_file(shell: str, tmp_path: Path) -> None:
    """As the page has it; zsh's comes after compinit."""
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell}")
    write_program(tmp_path / "shmmap", f'exec "{sys.executable}" -m shmmap.cli "$@"')
    (line,) = (line for line in COMPLETION if f"completion {shell}" in line)
    before = "autoload -Uz compinit && compinit -u -D; " if shell == "zsh" else ""
    there = {"bash": "complete -p shmmap", "zsh": "echo $_comps[shmmap]", "fish": "complete -c shmmap"}
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [shell, "-c", f"{before}{line}\n{there[shell]}"],
        capture_output=True,
        text=True,
        env={**environment, "HOME": str(tmp_path)},
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "shmmap" in done.stdout


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_read_their_script(shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell}")
    subprocess.run([shell, "-n", script_of(shell)], check=True, timeout=60)


if __name__ == "__main__":
    for one in SHELLS:
        script_of(one).write_text(generated(one), encoding="utf-8")
