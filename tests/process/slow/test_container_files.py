# SPDX-License-Identifier: Apache-2.0
"""`systemd/container/`: the Dockerfile's steps and the compose file's containers, in namespaces."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.process.distributions import tree
from tests.support.container_root import ContainerRoot, Image, read_compose
from tests.support.daemon_process import ROOT, Deadline
from tests.support.divided_map import make_map
from tests.support.namespaces import namespaces_or_skip
from tests.support.pages import read_page, write_program

FILES = ROOT / "systemd" / "container"
PAGE = read_page("shmmap/CONTAINERS.md")


def test_the_image_has_the_packages_of_the_slim_install() -> None:
    """And so everything that a map server needs."""
    page = (ROOT / "shmmap" / "INSTALL.md").read_text(encoding="utf-8")
    slim = re.search(r"<!-- slim -->\n```sh\n.*pip install -q (.*?) && pip", page)
    assert slim is not None
    runs = [rest for word, rest in Image.read(FILES / "Dockerfile").steps if word == "RUN"]
    assert any(run.endswith(f"-q {slim[1]}") for run in runs)


def test_the_page_names_the_files() -> None:
    """No container runtime is needed here: what it does with the files is done with namespaces."""
    build, compose = PAGE.commands("image")
    assert build == f"docker build -f {(FILES / 'Dockerfile').relative_to(ROOT)} -t shmmap ."
    assert compose == (
        f"MAPS=/srv/maps/town docker compose -f {(FILES / 'compose.yaml').relative_to(ROOT)} up"
    )
    services = read_compose(FILES / "compose.yaml")["services"]
    assert {one["image"] for one in services.values()} == {"shmmap"}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ContainerRoot]:
    """The image, built once."""
    namespaces_or_skip("--mount", "--pid", "--ipc")
    image = Image.read(FILES / "Dockerfile")
    ignored = (FILES / "Dockerfile.dockerignore").read_text(encoding="utf-8").split()
    files = sorted(name for name in tree() if not name.startswith(tuple(f"{one}/" for one in ignored)))
    try:
        one = ContainerRoot(tmp_path_factory.mktemp("container"), image, ROOT, files)
    except OSError as error:
        pytest.skip(f"no overlay of this machine: {error}")
    yield one
    one.close()


@pytest.mark.root
def test_a_daemon_and_two_clients_share_one_map(root: ContainerRoot, tmp_path: Path) -> None:
    made = make_map(tmp_path / "map", columns=4, rows=4, points=200)
    image, compose = root.image, read_compose(FILES / "compose.yaml")
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


@pytest.mark.root
@pytest.mark.parametrize("block", ["host", "tmpfs"])
def test_a_daemon_on_the_host_has_clients_in_containers(
    root: ContainerRoot, tmp_path: Path, block: str
) -> None:
    """The page's lines, on a host with /run, /dev/shm and the group `shmmap` of its own."""
    made = make_map(tmp_path / "map", columns=2, rows=2, points=200)
    write_program(tmp_path / "shmmap", f'PYTHONPATH="{ROOT}" exec "{sys.executable}" -m shmmap.cli "$@"')
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "HOME": str(tmp_path)}

    def on_host(script: str) -> subprocess.CompletedProcess[str]:
        words = root.on_host(script, environment)
        return subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)

    done = on_host(f"""
        mount -t tmpfs tmpfs /run; mount -t tmpfs -o mode=1777 tmpfs /dev/shm
        {{ cat /etc/group; getent group shmmap >/dev/null || echo shmmap:x:61002:; }} >{tmp_path}/group
        mount --bind {tmp_path}/group /etc/group
    """)
    assert done.returncode == 0, done.stderr
    *prepared, serve = (line for line in PAGE.commands(block) if not line.startswith("docker "))
    if (segments := re.search(r" --shm-dir (\S+)", serve)) is not None:
        environment["SHMMAP_SHM_DIR"] = segments[1]  # health has no other way to know it
    log = tmp_path / "log"
    try:
        for line in prepared:
            assert (done := on_host(line)).returncode == 0, done.stderr
        with log.open("wb") as file:
            words = root.on_host(f"exec {serve.replace(' MAP ', f' {made.root} ')}", environment)
            daemon = subprocess.Popen(words, stdout=file, stderr=file)
        try:
            waiting = Deadline()
            while waiting(on_host("shmmap health").returncode != 0):
                assert daemon.poll() is None, log.read_text()
            for line in PAGE.commands(block):
                if line.startswith("docker "):
                    found = root.docker_run(line, "shmmap", "query", "--circle", "0,0,50", "--json")
                    assert found.returncode == 0, found.stderr
                    assert len(json.loads(found.stdout)["cells"]) == 4
            if block == "host":
                outsider = line.partition(" --group-add")[0] + " IMAGE"
                refused = root.docker_run(outsider, "shmmap", "query", "--circle", "0,0,50")
                assert "may not connect" in refused.stderr
        finally:
            daemon.terminate()
            assert daemon.wait(60) == 0, log.read_text()
    finally:
        done = on_host("umount /etc/group /dev/shm; umount -l /run")
        assert done.returncode == 0, done.stderr


def first_of(container: subprocess.Popen[bytes]) -> int:
    """Return the id outside of a container's first process."""
    (inner,) = Path(f"/proc/{container.pid}/task/{container.pid}/children").read_text().split()
    return int(inner)
