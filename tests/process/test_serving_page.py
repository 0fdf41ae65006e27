# SPDX-License-Identifier: Apache-2.0
"""SERVING_FROM_A_BUCKET.md is true: its commands run as they stand, its settings are settings."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

import pytest

import shmmap
from shmmap.daemon.config import load_config
from tests.process.conftest import DaemonFactory
from tests.support.bucket_server import KEYS, BucketServer
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import make_map
from tests.support.faulty_web import faulty_web
from tests.support.forked_programs import run_verb
from tests.support.pages import read_page
from tests.support.published_daemon import ALL, all_cells, until, until_taken
from tests.support.publishing import publish

PAGE = read_page("shmmap/publishing/SERVING_FROM_A_BUCKET.md")


def test_every_block_is_tested() -> None:
    shown = {"health", "status", "doctor", "log"}
    assert set(PAGE.blocks) == {"install", "credentials", "serve", "ask", "settings", "down", "trust", *shown}
    assert PAGE.fences == len(PAGE.blocks) - len(shown) - 1  # one is of settings


def test_packages_are_those_of_the_extra() -> None:
    (install,) = PAGE.commands("install")
    text = (ROOT / "shmmap/publishing/SERVING_FROM_A_BUCKET.md").read_text(encoding="utf-8")
    (signing,) = re.findall(r"`pip install (tuf [^`]+)`", text)
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (extra,) = re.findall(r"^remote = \[\n(.*?)^\]", project, re.MULTILINE | re.DOTALL)
    assert install.split()[3:] == re.findall(r'"([a-z]+)>=', extra)
    (extra,) = re.findall(r"^sign = \[\n(.*?)^\]", project, re.MULTILINE | re.DOTALL)
    assert shlex.split(signing) == re.findall(r'"([a-z\[\]]+)>=', extra)


def test_settings_are_settings(tmp_path: Path) -> None:
    file = tmp_path / "shmmap.toml"
    file.write_text("\n".join(PAGE.blocks["settings"]))
    config = load_config({}, file=str(file), environ={})
    assert (config.map_path, config.poll_s) == ("s3://maps/town", 60.0)
    assert config.catalogue_budget_bytes == 256 << 20


@pytest.mark.usefixtures("layer_kernels")
def test_a_map_is_served_from_a_bucket(buckets: BucketServer, daemon: DaemonFactory, tmp_path: Path) -> None:
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    made = make_map(tmp_path / "town", columns=2, rows=2, points=4000)
    publish(made.root, buckets.url("vehicle/town"))
    (serve,) = PAGE.commands("serve")
    assert serve == f"shmmap serve {buckets.url('town')}"
    serve = serve.replace("maps/", "maps/vehicle/")  # the bucket has what other tests have published
    exports = [line.removeprefix("export ").split("=", 1) for line in PAGE.commands("credentials")]
    assert dict(exports).keys() <= buckets.environment.keys()
    environment = buckets.environment
    one = daemon(serve.split()[2], environment=environment)

    def run(line: str) -> str:
        words = [*shlex.split(line)[1:], "--instance", one.instance, "--runtime-dir", one.runtime_dir]
        words += ["--shm-dir", one.shm_dir] if words[0] == "health" else []
        done = run_verb(words)
        assert done.returncode == 0, done.stderr
        return done.stdout

    query, health, reload = map(run, PAGE.commands("ask"))
    assert all(name in query for name in made.corners)
    assert "ndt(leaf=2.0" in query
    assert health.startswith("healthy")
    assert reload.startswith("0 cells changed")


def verb(one: DaemonProcess, line: str) -> tuple[int, str]:
    """Run a command of the page for this daemon; returns its exit code and output."""
    words = shlex.split(line)[1:]
    place = ["--instance", one.instance, "--runtime-dir", one.runtime_dir]
    place += ["--shm-dir", one.shm_dir] if words[0] != "tail" else []
    done = run_verb([*words, *place], {**os.environ, "COLUMNS": "400"})
    return done.returncode, done.stdout


def is_shown(line: str, text: str) -> bool:
    """Whether a line of the page is printed, apart from its numbers, times and blanks."""
    fixed = re.split(r"\d+(?:\.\d+)? [smhd]\b|\d+", " ".join(line.split()))
    pattern = r"[\w. ]+?".join(re.escape(part) for part in fixed)
    return re.search(pattern, " ".join(text.split())) is not None


def test_the_link_is_down(daemon: DaemonFactory, tmp_path: Path) -> None:
    """The page's commands, their output, and which cells are served meanwhile."""
    pytest.importorskip("obstore", reason="obstore is not installed")
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    made = make_map(tmp_path / "files", columns=2, rows=2, points=300)
    publish(made.root, tmp_path / "www/maps/town")
    (serve,) = PAGE.commands("serve")
    with faulty_web(tmp_path / "www") as web:
        one = daemon(serve.split()[2], "--poll", "1", environment={**KEYS, "AWS_ENDPOINT_URL": web.url})
        with shmmap.connect(one.endpoint) as client:
            near = client.around(-15.0, -15.0, 2.0, wait=60.0)
            assert near.complete
            until_taken(one)
            web.refuse()
            until(lambda: verb(one, "shmmap health --strict")[0] == 1)
            cells = client.area(ALL, wait=60.0)
            assert {failure.code for failure in cells.failed} == {"offline"}
            assert {cell.id for cell in cells} == {cell.id for cell in near}
            commands = dict(zip(("health", "status", "doctor", "tail"), PAGE.commands("down"), strict=True))
            for name in ("health", "status", "doctor"):
                code, text = verb(one, commands[name])
                assert code == (1 if name == "health" else 0), text
                for line in PAGE.blocks[name]:
                    assert is_shown(line, text), f"{line}\n\n{text}"
            assert "offline" in verb(one, commands["tail"])[1]
            with pytest.raises(shmmap.Offline):
                client.reload()
            del cells
        one.stop()
        one.start()
        with shmmap.connect(one.endpoint) as client:
            again = client.around(-15.0, -15.0, 2.0, wait=60.0)
            assert {cell.version for cell in again} == {cell.version for cell in near}
            until(lambda: one.log.count("the map's origin is out of reach") >= 2)
            web.listen()
            all_cells(client)
        for line in PAGE.blocks["log"]:
            until(lambda line: is_shown(line, one.log), line)
        until(lambda: verb(one, "shmmap health --strict")[0] == 0)


def test_a_signed_map_is_served(buckets: BucketServer, daemon: DaemonFactory, tmp_path: Path) -> None:
    pytest.importorskip("tuf", reason="tuf is not installed")
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    made = make_map(tmp_path / "town", columns=2, rows=1, points=100)
    keys = tmp_path / "keys"
    publish(made.root, buckets.url("vehicle/signed"), "--sign", str(keys))
    (serve,) = PAGE.commands("trust")
    _, _, url, option, root = shlex.split(serve)
    assert (url, root) == (buckets.url("signed"), "ROOT.json")
    environment = buckets.environment
    words = url.replace("maps/", "maps/vehicle/"), option, str(keys / root)
    one = daemon(*words, environment=environment)
    with shmmap.connect(one.endpoint) as client:
        assert client.around(0, 0, radius=500, wait=60.0).complete
    secret = environment["AWS_SECRET_ACCESS_KEY"]
    kept = [path for path in one.state_dir.rglob("*") if path.is_file()]
    assert kept
    assert not [path for path in kept if secret.encode() in path.read_bytes()]
