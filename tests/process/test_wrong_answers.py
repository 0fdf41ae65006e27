# SPDX-License-Identifier: Apache-2.0
"""Verbs and daemons at a store whose answers are wrong: the cause in the first line, signals at once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.command_line import publish
from tests.support.daemon_process import ROOT, until
from tests.support.divided_map import make_map
from tests.support.forked_programs import run_verb
from tests.support.map_stores import KEYS
from tests.support.web_servers import WRONG_ANSWERS, FaultyWeb, endless_error, faulty_web

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

TOWN = "maps/town"
ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith(("SHMMAP_", "AWS_"))} | {
    "PYTHONPATH": str(ROOT), **KEYS, "AWS_SESSION_TOKEN": "of-the-tests",
}  # fmt: skip


@pytest.fixture
def web(tmp_path: Path) -> Iterator[FaultyWeb]:
    """A web server that has a published map below the path of a bucket; also a bucket's, for reading."""
    made = make_map(tmp_path / "town", columns=2, rows=2, points=300)
    publish(made.root, tmp_path / "www" / TOWN)
    with faulty_web(tmp_path / "www") as one:
        yield one


def words_of(verb: str, web: FaultyWeb, folder: Path, scheme: str = "http") -> list[str]:
    url = f"{web.url}/{TOWN}" if scheme == "http" else "s3://maps/town"
    own = ["--instance", f"wrong-{os.getpid()}", "--runtime-dir", str(folder / "run")]
    return {
        "versions": ["versions", url],
        "fetch": ["fetch", url, str(folder / "fetched")],
        "publish": ["publish", str(folder / "town"), url, "--workers", "1"],
        "serve": ["serve", url, "--poll", "0", *own],
    }[verb]


@pytest.mark.parametrize(
    ("fault", "says"),
    [("page", "what the store answers is no map: a page (text/html)"), ("redirect", "it is somewhere else")],
)
def test_verbs_say_the_cause_in_their_first_line(
    web: FaultyWeb, tmp_path: Path, fault: str, says: str
) -> None:
    environment = {**ENVIRONMENT, "XDG_STATE_HOME": str(tmp_path / "state"), "AWS_ENDPOINT_URL": web.url}
    with faulty_web(tmp_path / "www") as other:
        there = other.url.replace("127.0.0.1", "localhost")
        web.fault = lambda _path: fault if fault == "page" else f"redirect {there}"
        for verb, scheme in (("versions", "http"), ("fetch", "s3"), ("serve", "http"), ("publish", "s3")):
            done = run_verb(words_of(verb, web, tmp_path, scheme), environment)
            said = [line for line in done.stderr.splitlines() if line.startswith("shmmap: ")]
            assert says in said[0], (verb, done.stderr)
            assert done.returncode in (71, 75), verb  # both say: try again later
        assert not other.connections, "no other host is asked"


@pytest.mark.parametrize(
    ("verb", "scheme", "fault", "number", "code"),
    [
        ("versions", "http", "drip body", signal.SIGINT, 130),
        ("versions", "s3", "continue", signal.SIGINT, 130),
        ("fetch", "http", "objects", signal.SIGINT, 130),
        ("fetch", "s3", "objects", signal.SIGINT, 130),
        ("publish", "s3", "drip head", signal.SIGINT, 130),
        ("serve", "http", "drip body", signal.SIGTERM, 0),
        ("serve", "s3", "stall", signal.SIGINT, 0),
    ],
)
def test_signals_end_what_waits_for_a_store(
    web: FaultyWeb, tmp_path: Path, verb: str, scheme: str, fault: str, number: signal.Signals, code: int
) -> None:
    """While the store goes on as it does; verbs would wait for 30 s and longer."""
    environment = {**ENVIRONMENT, "XDG_STATE_HOME": str(tmp_path / "state"), "AWS_ENDPOINT_URL": web.url}
    asked: list[str] = []

    def wrong(path: str) -> str:
        is_object = path.startswith(f"{TOWN}/blobs/")
        if fault == "objects":
            asked.extend([path] * is_object)
            return "drip head" if len(asked) > 2 else ""  # root and shard come
        asked.append(path)
        return fault

    web.fault = wrong
    process = subprocess.Popen(
        [sys.executable, "-m", "shmmap.cli", *words_of(verb, web, tmp_path, scheme)],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    with process:
        until(lambda: len(asked) > 2 * (fault == "objects"))
        process.send_signal(number)
        said, _ = process.communicate(timeout=20.0)
    assert process.returncode == code, said
    assert "Traceback" not in said


@pytest.mark.slow
def test_an_error_without_end_takes_no_memory(
    web: FaultyWeb, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A verb that kept what comes until its limit, 62 s, would need ten times what this one is allowed."""
    environment = {**ENVIRONMENT, "XDG_STATE_HOME": str(tmp_path / "state"), "AWS_ENDPOINT_URL": web.url}
    monkeypatch.setitem(WRONG_ANSWERS, "endless error", endless_error)
    web.fault = lambda _path: "endless error"
    for verb, code in (("versions", 75), ("fetch", 75), ("serve", 71), ("publish", 75)):
        command = [sys.executable, "-m", "shmmap.cli", *words_of(verb, web, tmp_path, "s3")]
        done = subprocess.run(
            ["bash", "-c", f'ulimit -d {2 << 20}; exec "$@"', "bash", *command],
            env=environment, capture_output=True, text=True,
        )  # fmt: skip
        said = [line for line in done.stderr.splitlines() if line.startswith("shmmap: ")]
        assert said, (verb, done)
        assert "its answer, which is no object, has more than 64 MiB" in said[0], (verb, done.stderr)
        assert done.returncode == code, (verb, done.stderr)


@pytest.mark.slow
@pytest.mark.minutes
def test_verbs_wait_as_long_as_the_page_says(web: FaultyWeb, tmp_path: Path) -> None:
    """A whole answer has 31 s; one of a bucket that is an error 62 s."""
    environment = {**ENVIRONMENT, "XDG_STATE_HOME": str(tmp_path / "state"), "AWS_ENDPOINT_URL": web.url}
    web.fault = lambda path: "drip error" if path.startswith("maps/bad") else "drip body"
    asked = {f"{web.url}/{TOWN}": 31, "s3://maps/town": 31, "s3://maps/bad": 62}
    started = {
        url: subprocess.Popen(
            [sys.executable, "-m", "shmmap.cli", "versions", url],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )
        for url in asked
    }  # fmt: skip
    for url, process in started.items():
        with process:
            said, _ = process.communicate(timeout=120.0)
        assert f"the answer was not complete within {asked[url]} s" in said.splitlines()[0]
        assert process.returncode == 75


def test_a_spoilt_token_is_an_error_with_a_name(web: FaultyWeb, tmp_path: Path) -> None:
    environment = {**ENVIRONMENT, "XDG_STATE_HOME": str(tmp_path / "state"), "AWS_ENDPOINT_URL": web.url}
    spoilt = {**environment, "AWS_SESSION_TOKEN": "to\nken"}
    for verb in ("versions", "serve", "publish"):
        done = run_verb(words_of(verb, web, tmp_path, "s3"), spoilt)
        assert done.returncode == 78
        assert "shmmap: AWS_SESSION_TOKEN has a line break after its first 2 characters" in done.stderr
    ended_by_newline = {**environment, "AWS_SESSION_TOKEN": "token\n"}
    assert run_verb(words_of("fetch", web, tmp_path, "s3"), ended_by_newline).returncode == 0
