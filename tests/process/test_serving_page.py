# SPDX-License-Identifier: Apache-2.0
"""SERVING_FROM_A_BUCKET.md is true: its commands run as they stand, its settings are settings."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import shmmap
from shmmap.daemon.config import load_config
from tests.process.conftest import DaemonFactory
from tests.support.bucket_server import BucketServer
from tests.support.daemon_process import ROOT
from tests.support.divided_map import make_map
from tests.support.pages import read_page
from tests.support.publishing import publish

PAGE = read_page("shmmap/publishing/SERVING_FROM_A_BUCKET.md")


def test_every_block_is_tested() -> None:
    assert set(PAGE.blocks) == {"install", "credentials", "serve", "ask", "settings", "trust"}
    assert PAGE.fences == len(PAGE.blocks) - 1  # one is of settings


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
    environment = {**dict(exports), "AWS_ENDPOINT_URL": buckets.endpoint}
    one = daemon(serve.split()[2], environment=environment)

    def run(line: str) -> str:
        words = [*shlex.split(line)[1:], "--instance", one.instance, "--runtime-dir", one.runtime_dir]
        words += ["--shm-dir", one.shm_dir] if words[0] == "health" else []
        done = subprocess.run(
            [sys.executable, "-m", "shmmap.cli", *words],
            env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    query, health, reload = map(run, PAGE.commands("ask"))
    assert all(name in query for name in made.corners)
    assert "ndt(leaf=2.0" in query
    assert health.startswith("healthy")
    assert reload.startswith("0 cells changed")


def test_a_signed_map_is_served(buckets: BucketServer, daemon: DaemonFactory, tmp_path: Path) -> None:
    pytest.importorskip("tuf", reason="tuf is not installed")
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    made = make_map(tmp_path / "town", columns=2, rows=1, points=100)
    keys = tmp_path / "keys"
    publish(made.root, buckets.url("vehicle/signed"), "--sign", str(keys))
    (serve,) = PAGE.commands("trust")
    _, _, url, option, root = shlex.split(serve)
    assert (url, root) == (buckets.url("signed"), "ROOT.json")
    exports = [line.removeprefix("export ").split("=", 1) for line in PAGE.commands("credentials")]
    environment = {**dict(exports), "AWS_ENDPOINT_URL": buckets.endpoint}
    words = url.replace("maps/", "maps/vehicle/"), option, str(keys / root)
    one = daemon(*words, environment=environment)
    with shmmap.connect(one.endpoint) as client:
        assert client.around(0, 0, radius=500, wait=60.0).complete
    secret = environment["AWS_SECRET_ACCESS_KEY"]
    kept = [path for path in one.state_dir.rglob("*") if path.is_file()]
    assert kept
    assert not [path for path in kept if secret.encode() in path.read_bytes()]
