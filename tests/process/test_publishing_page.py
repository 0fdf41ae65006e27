# SPDX-License-Identifier: Apache-2.0
"""PUBLISHING.md is true: its commands run as they stand, one after the other."""

from __future__ import annotations

import os
import shlex
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.support.daemon_process import ROOT
from tests.support.divided_map import make_map
from tests.support.map_stores import BucketServer
from tests.support.pages import read_page

PAGE = read_page("shmmap/publishing/PUBLISHING.md")

pytestmark = pytest.mark.usefixtures("layer_kernels")


def test_every_block_is_tested() -> None:
    assert set(PAGE.blocks) == {
        "install", "credentials", "publish", "directory", "fetch", "install-sign", "sign", "rotate",
        "versions",
    }  # fmt: skip
    assert PAGE.fences == len(PAGE.blocks)


def test_packages_are_those_of_the_extra() -> None:
    import re

    (install,) = PAGE.commands("install")
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (extra,) = re.findall(r"^remote = \[\n(.*?)^\]", project, re.MULTILINE | re.DOTALL)
    assert install.split()[3:] == re.findall(r'"([a-z]+)>=', extra)
    (install,) = PAGE.commands("install-sign")
    (extra,) = re.findall(r"^sign = \[\n(.*?)^\]", project, re.MULTILINE | re.DOTALL)
    assert shlex.split(install)[3:] == re.findall(r'"([a-z\[\]]+)>=', extra)


def test_a_map_is_published_fetched_and_goes_back(tmp_path: Path, buckets: BucketServer) -> None:
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    made = make_map(tmp_path / "town", columns=2, rows=2, points=300)
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("SHMMAP_", "AWS_"))}
    environment |= {"HOME": str(tmp_path), "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    exports = PAGE.commands("credentials")
    assert all(line.startswith("export AWS_") for line in exports)
    given = dict(line.removeprefix("export ").split("=", 1) for line in exports)
    assert given["AWS_ENDPOINT_URL"].startswith("http://127.0.0.1:")
    assert given.keys() <= buckets.environment.keys()
    environment |= buckets.environment
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])

    def command(line: str) -> list[str]:
        name, *words = shlex.split(line.replace("8000", port).replace("~/", f"{tmp_path}/"))
        return [sys.executable, *(["-m", "shmmap.cli"] if name == "shmmap" else []), *words]

    def run(line: str) -> str:
        done = subprocess.run(command(line), env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    publish, versions = PAGE.commands("publish")
    assert "version  1\n" in run(publish)
    assert "current" in run(versions)
    made.change("0_0.pcd", seed=5, count=300)
    assert "sent     4 objects" in run(publish)
    into_directory, serve = PAGE.commands("directory")
    assert "/town/..." in run(into_directory)
    server = subprocess.Popen(command(serve), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while server.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", int(port))) == 0:
                    break
            time.sleep(0.01)
        listed, fetched = map(run, PAGE.commands("fetch"))
    finally:
        server.kill()
        server.wait()
    assert "current" in listed
    assert "4 cells, 1,200 points" in fetched
    back = tmp_path / "back/pointcloud_map.pcd"
    for name in made.corners:
        assert (back / name).read_bytes() == (made.pcd_dir / name).read_bytes()
    rolled_back, pruned = map(run, PAGE.commands("versions"))
    assert rolled_back == "version 3 is current: the content of version 1\n"
    assert "removed  no version; 0 objects" in pruned
    pytest.importorskip("tuf", reason="tuf is not installed")
    environment["XDG_STATE_HOME"] = str(tmp_path / "state")
    signed, refreshed, listed, verified = map(run, PAGE.commands("sign"))
    assert "version  1\n" in signed
    assert "version 1 is signed" in refreshed
    assert "version 1 is signed, until" in listed
    assert "4 cells, 1,200 points" in verified
    (rotated,) = map(run, PAGE.commands("rotate"))
    assert rotated.startswith("targets: signed by a new key, as root of trust 3 says\n")
    assert "version 1 is signed, until" in run(PAGE.commands("sign")[2])
