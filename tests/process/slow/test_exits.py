# SPDX-License-Identifier: Apache-2.0
"""Programs that end while a thread asks: by themselves, and without a word.

The scenes are those of ``tests/benchmarks/exits.py``, which has two hundred exits of each.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading

import pytest

import shmmap
from shmmap.errors import BadRequest
from tests.benchmarks.exits import SCENES, Ends, end_often
from tests.support.daemon_process import DaemonProcess

EXITS = 4


@pytest.mark.parametrize("scene", SCENES)
def test_a_program_ends_quietly(standing: DaemonProcess, scene: str) -> None:
    assert end_often(standing.endpoint, *SCENES[scene], EXITS) == Ends(0, 0, 0, "")


def test_no_client_waits_for_the_answer_of_a_daemon_that_stands_still(served: DaemonProcess) -> None:
    setup = (
        "import os, signal; client = shmmap.connect(endpoint, timeout=600)\n"
        "os.kill(client.welcome.pid, signal.SIGSTOP)"
    )
    try:
        assert end_often(served.endpoint, setup, "asked.set(); client.around(0, 0, 50)", 1) == Ends(
            0, 0, 0, ""
        )
    finally:
        served.send(signal.SIGCONT)


def test_threads_that_python_waits_for_ask_to_their_end(standing: DaemonProcess) -> None:
    code = (
        "import sys, threading, shmmap\n"
        "client = shmmap.connect(sys.argv[1])\n"
        "def work():\n"
        "    threading.main_thread().join()\n"
        "    with shmmap.connect(sys.argv[1]) as own:\n"
        "        print(all(one.around(0, 0, 50).complete for one in (client, own) for _ in range(100)))\n"
        "threading.Thread(target=work).start()\n"
    )
    done = subprocess.run([sys.executable, "-c", code, standing.endpoint], capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"True\n", b"")


def test_a_function_for_the_end_may_ask_and_gets_a_clear_error_of_a_closed_client(
    standing: DaemonProcess,
) -> None:
    code = (
        "import atexit, sys, shmmap\n"
        "@atexit.register\n"
        "def last():\n"
        "    print(client.around(0, 0, 50).complete)\n"
        "    client.close()\n"
        "    try:\n"
        "        client.around(0, 0, 50)\n"
        "    except shmmap.BadRequest as error:\n"
        "        print(error)\n"
        "client = shmmap.connect(sys.argv[1])\n"
    )
    done = subprocess.run([sys.executable, "-c", code, standing.endpoint], capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (
        0,
        b"True\nthis client is closed (connect again)\n",
        b"",
    )


def test_closing_a_stream_that_another_thread_waits_on(standing: DaemonProcess) -> None:
    stream = shmmap.events.EventStream(standing.endpoint)
    failures: list[BaseException] = []

    def wait() -> None:
        try:
            while True:
                stream.next()
        except BadRequest as error:
            failures.append(error)

    threads = [threading.Thread(target=wait) for _ in range(2)]
    for thread in threads:
        thread.start()
    stream.close()
    for thread in threads:
        thread.join()
    assert [str(failure) for failure in failures] == ["this event stream is closed (make another one)"] * 2
