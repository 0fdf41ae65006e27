# SPDX-License-Identifier: Apache-2.0
"""Starting a program, which takes the interpreter lock from no other thread."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from shmmap.processes.start_program import start_program


def output_of(program: str, *arguments: str, inherited: tuple[int, ...] = ()) -> tuple[str, int]:
    """What a Python program writes, and its exit code."""
    ours, theirs = os.pipe()
    try:
        command = [sys.executable, "-c", program, *arguments]
        pid = start_program(command, {"WORD": "a=b é"}, theirs, inherited)
    finally:
        os.close(theirs)
    with open(ours) as pipe:
        written = pipe.read()
    return written, os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def test_arguments_environment_and_exit_code() -> None:
    program = "import os, sys; print(sys.argv[1:], os.environ['WORD'], repr(sys.stdin.read())); sys.exit(7)"
    assert output_of(program, "x y", "", "ü") == ("['x y', '', 'ü'] a=b é ''\n", 7)


def test_it_has_the_descriptors_that_are_named(tmp_path: Path) -> None:
    program = """if True:
        import os, sys
        for fd in (0, 1, 2, *map(int, sys.argv[1:])):
            try:
                print(os.readlink(f"/proc/self/fd/{fd}"))
            except FileNotFoundError:
                print("closed")
    """
    kept, other = (os.open(path, os.O_RDONLY) for path in (tmp_path, "/"))
    try:
        lines = output_of(program, str(kept), str(other), inherited=(kept,))[0].splitlines()
    finally:
        os.close(kept)
        os.close(other)
    assert lines[1].startswith("pipe:")
    assert [lines[0], *lines[2:]] == ["/dev/null", "/dev/null", str(tmp_path), "closed"]


def test_what_cannot_be_started(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        start_program([str(tmp_path / "nowhere")], {}, 1)


WAITS = """if True:
    import os, sys, threading
    from shmmap.processes.start_program import start_program

    sys.setswitchinterval(1000.0)  # only a thread that waits gives the lock to the other
    os.devnull = sys.argv[1]  # which the child opens before it runs its program
    begun = threading.Event()

    def start():
        begun.set()
        os.waitpid(start_program(["/bin/true"], {}, 1), 0)

    thread = threading.Thread(target=start, daemon=True)
    thread.start()
    begun.wait()
    os.open(os.devnull, os.O_RDWR)
    thread.join()
"""


def test_other_threads_run_while_the_child_waits(tmp_path: Path) -> None:
    """A child waits for a processor as this one waits for the other end of a pipe."""
    os.mkfifo(tmp_path / "nothing")
    subprocess.run([sys.executable, "-c", WAITS, tmp_path / "nothing"], check=True, timeout=60)
