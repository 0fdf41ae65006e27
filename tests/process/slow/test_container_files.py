# SPDX-License-Identifier: Apache-2.0
"""`systemd/container/`: the Dockerfile's steps and the compose file's containers, in namespaces."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.process.distributions import tree
from tests.support.container_root import ContainerRoot, Image, read_compose
from tests.support.daemon_process import ROOT, Deadline
from tests.support.divided_map import make_map
from tests.support.namespaces import namespaces_or_skip

FILES = ROOT / "systemd" / "container"


def test_the_image_has_the_packages_of_the_slim_install() -> None:
    """And so everything that a map server needs."""
    page = (ROOT / "shmmap" / "INSTALL.md").read_text(encoding="utf-8")
    slim = re.search(r"<!-- slim -->\n```sh\n.*pip install -q (.*?) && pip", page)
    assert slim is not None
    runs = [rest for word, rest in Image.read(FILES / "Dockerfile").steps if word == "RUN"]
    assert any(run.endswith(f"-q {slim[1]}") for run in runs)


@pytest.mark.root
def test_a_daemon_and_two_clients_share_one_map(tmp_path: Path) -> None:
    namespaces_or_skip("--mount", "--pid", "--ipc")
    made = make_map(tmp_path / "map", columns=4, rows=4, points=200)
    image, compose = Image.read(FILES / "Dockerfile"), read_compose(FILES / "compose.yaml")
    ignored = (FILES / "Dockerfile.dockerignore").read_text(encoding="utf-8").split()
    files = sorted(name for name in tree() if not name.startswith(tuple(f"{one}/" for one in ignored)))
    place = tmp_path / "container"
    place.mkdir()
    try:
        root = ContainerRoot(place, image, ROOT, files)
    except OSError as error:
        pytest.skip(f"no overlay of this machine: {error}")
    processes: list[subprocess.Popen[bytes]] = []
    try:
        volumes = {
            name: root.prepare_volume(name, ((options or {}).get("driver_opts") or {}).get("o", ""))
            for name, options in compose["volumes"].items()
        }
        volumes["${MAPS:?a map}"] = str(made.root)

        def mounts(service: dict[str, Any]) -> list[tuple[str, str, str]]:
            found = []
            for text in service["volumes"]:
                match = re.fullmatch(r"(\$\{.*\}|\w+):(/[\w/]+)(?::(ro))?", text)
                assert match is not None, text
                found.append((volumes[match[1]], match[2], match[3] or "rw"))
            return found

        services = compose["services"]
        daemon = services.pop("map")
        assert all(
            one["depends_on"] == {"map": {"condition": "service_healthy"}} for one in services.values()
        )
        log = tmp_path / "daemon.log"
        processes.append(root.start(daemon.get("command", image.command), mounts(daemon), log))
        how, *health = daemon["healthcheck"]["test"]
        assert how == "CMD"
        waiting = Deadline()
        while waiting(root.run(health, volumes=mounts(daemon)).returncode != 0):
            assert processes[0].poll() is None, log.read_text()
        segments: dict[str, set[str]] = {}
        for name, service in services.items():
            done = root.run([*service["command"], "--json"], volumes=mounts(service))
            assert done.returncode == 0, done.stderr
            cells = json.loads(done.stdout)["cells"]
            assert len(cells) == 16
            segments[name] = {cell["segment"] for cell in cells}
        again = root.run([*services["localization"]["command"], "--json"], volumes=mounts(daemon))
        assert {cell["segment"] for cell in json.loads(again.stdout)["cells"]} == segments["localization"]
        refused = root.run(["touch", "/segments/x"], volumes=mounts(services["perception"]))
        assert "Read-only file system" in refused.stderr
        look = [(volumes["segments"], "/look", "rw")]
        assert root.run(["ls", "/look"], volumes=look).stdout.count("\n") > 16
        os.kill(first_of(processes[0]), signal.SIGTERM)  # docker stop
        assert processes[0].wait(60) == 0
        assert root.run(["ls", "/look"], volumes=look).stdout == ""
    finally:
        for process in processes:
            process.kill()
            process.wait(60)
        root.close()


def first_of(container: subprocess.Popen[bytes]) -> int:
    """Return the id outside of a container's first process."""
    (inner,) = Path(f"/proc/{container.pid}/task/{container.pid}/children").read_text().split()
    return int(inner)
