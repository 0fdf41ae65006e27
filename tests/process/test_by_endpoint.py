# SPDX-License-Identifier: Apache-2.0
"""Verbs find a daemon by its endpoint alone, whatever its instance and its directories are called."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.forked_programs import run_verb

VERBS = (("health",), ("status",), ("top", "--once"), ("metrics",), ("doctor", "--json"))


def shmmap(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SHMMAP_")}
    return run_verb(words, {**environment, **variables}, "/")


@pytest.fixture
def other_name(daemon: DaemonFactory, divided_map: DividedMap) -> DaemonProcess:
    """A daemon whose socket has another name than its instance, and whose segments are elsewhere."""
    one = daemon(divided_map.root, start=False)
    one.endpoint = f"{one.runtime_dir}/front.sock"
    one.arguments += ["--endpoint", one.endpoint]
    return one.start()


def check_found(one: DaemonProcess, *options: str, **variables: str) -> None:
    for words in VERBS:
        done = shmmap(*words, *options, **variables)
        assert str(one.pid) in done.stdout or words[0] in ("metrics", "top"), (words, done)
        assert done.returncode == 0 or words[0] == "doctor", (words, done.stderr)
        if words[0] == "doctor":
            assert "rm " not in done.stdout
            (finding,) = [one for one in json.loads(done.stdout)["findings"] if one["name"] == "daemon"]
            assert finding["state"] == "ok", finding
        elif words[0] == "metrics":
            assert re.search(r"^shmmap_up(\{.*\})? 1$", done.stdout, re.MULTILINE), done.stdout


def test_the_endpoint_is_enough(other_name: DaemonProcess) -> None:
    """As an option, and as a variable."""
    check_found(other_name, "--endpoint", other_name.endpoint)
    check_found(other_name, SHMMAP_ENDPOINT=f"ipc://{other_name.endpoint}")


def test_one_that_does_not_answer_is_found_by_its_statistics(
    other_name: DaemonProcess,
) -> None:
    """Among all in the directory: it is their endpoint that counts, not their name."""
    other_name.send(signal.SIGSTOP)
    options = ("--endpoint", other_name.endpoint, "--shm-dir", other_name.shm_dir)
    done = shmmap("health", *options)
    assert (done.returncode, done.stdout.split(":")[0]) == (1, "paused"), done
    other_name.send(signal.SIGCONT)


def test_another_daemon_of_the_socket_s_name_is_not_meant(
    daemon: DaemonFactory, other_name: DaemonProcess, divided_map: DividedMap
) -> None:
    """It is an instance called as the socket is, with statistics where one looks first."""
    namesake = daemon(divided_map.root, start=False, shm_dir=other_name.shm_dir)
    namesake.instance = "front"
    namesake.arguments += ["--endpoint", namesake.endpoint]
    namesake.start()
    options = ("--endpoint", other_name.endpoint, "--shm-dir", other_name.shm_dir)
    assert f"pid {other_name.pid}," in shmmap("health", *options).stdout
    assert shmmap("health", "--endpoint", f"{other_name.runtime_dir}/none.sock").returncode == 69
    other_name.stop()
    for verb in ("health", "metrics", "status"):
        done = shmmap(verb, *options)
        assert (done.returncode, str(namesake.pid) in done.stdout) == (69, False), done


def test_the_instance_and_its_directory_are_enough(other_name: DaemonProcess) -> None:
    """It listens where a client that knows its name alone does not look; its statistics have that name."""
    options = ("--instance", other_name.instance, "--shm-dir", other_name.shm_dir)
    for words in ("health",), ("status",), ("top", "--once"), ("metrics",):
        done = shmmap(*words, *options)
        assert done.returncode == 0, (words, done)
    assert f"pid {other_name.pid}," in shmmap("health", *options).stdout


def test_what_a_live_daemon_has_is_not_to_be_removed(other_name: DaemonProcess, short_path: Path) -> None:
    """Not even while it has no statistics: neither the instance that is examined, nor another one."""
    query = shmmap("query", "--endpoint", other_name.endpoint, "--circle", "0,0,5")
    assert query.returncode == 0
    other_name.send(signal.SIGSTOP)  # it would make them again
    os.unlink(f"{other_name.shm_dir}/shmmap.{other_name.instance}.statistics")
    for options in (["--endpoint", other_name.endpoint], ["--instance", other_name.instance], []):
        words = ("doctor", "--json", *options, "--shm-dir", other_name.shm_dir)
        done = shmmap(*words, XDG_RUNTIME_DIR=str(short_path))
        assert done.stdout, (options, done.returncode, done.stderr)
        (finding,) = [one for one in json.loads(done.stdout)["findings"] if one["name"] == "leftovers"]
        assert (finding["state"], "rm " in finding["advice"]) == ("warn", False), finding
    other_name.send(signal.SIGCONT)
