# SPDX-License-Identifier: Apache-2.0
"""Installs beside what there is: versions side by side, and in an image of another machine's disk."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.process.distributions import tree
from tests.support.container_root import ContainerRoot, Image, pip_variables
from tests.support.daemon_process import ROOT
from tests.support.namespaces import namespaces_or_skip
from tests.support.pages import Reader, read_page, write_program
from tests.support.skips import index_or_skip


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A clone of this tree, as it stands on disk; of its packages it asks for those of the command line."""
    folder = tmp_path / "shmmap"
    listed = "\0".join(tree())
    command = f"tar -C '{ROOT}' --null -T - -cf - | tar -C '{folder}' -xf - && cd '{folder}' && git init -q"
    folder.mkdir()
    subprocess.run(["sh", "-c", command], input=listed, text=True, check=True)
    project = folder / "pyproject.toml"
    text = project.read_text(encoding="utf-8")
    fewer, count = re.subn(
        r"^dependencies = \[\n.*?^\]",
        'dependencies = ["msgspec", "numpy", "tomli"]',
        text,
        flags=re.MULTILINE | re.DOTALL,
    )
    assert count == 1
    project.write_text(fewer, encoding="utf-8")
    identity = ["-c", "user.name=test", "-c", "user.email=test@localhost"]
    for words in (["add", "-A"], [*identity, "commit", "-q", "-m", "all"]):
        subprocess.run(["git", *words], cwd=folder, check=True)
    return folder


@pytest.fixture
def reader(tmp_path: Path) -> Iterator[Reader]:
    one = Reader(tmp_path, [], {"PIP_CACHE_DIR": str(Path.home() / ".cache" / "pip")})
    yield one
    one.leave()


def test_versions_side_by_side(reader: Reader, clone: Path, tmp_path: Path) -> None:
    """The link is switched from one to the other; what was started by the path behind it goes on."""
    install, switch = read_page("shmmap/INSTALL.md").commands("versions")
    here = tmp_path / "opt"
    (here / "shmmap-0.2.0").mkdir(parents=True)
    (here / "shmmap").symlink_to("shmmap-0.2.0")
    user = reader.terminal(clone)
    with index_or_skip():
        user.run(install.replace("/opt/", f"{here}/"))
    user.run(switch.replace("/opt/", f"{here}/"))
    assert [path.name for path in sorted(here.iterdir())] == ["shmmap", "shmmap-0.2.0", "shmmap-0.4.0"]
    found = reader.terminal().run(f"'{here}/shmmap/bin/python' -c 'import shmmap; print(shmmap.__file__)'")
    assert found.startswith(str(here))


@pytest.mark.root
def test_an_image_of_a_vehicle_s_disk(clone: Path, tmp_path: Path) -> None:
    """This machine stands for the image."""
    namespaces_or_skip("--mount", "--pid")
    (tmp_path / "container").mkdir()
    try:
        root = ContainerRoot(tmp_path / "container", Image(), ROOT, [])
    except OSError as error:
        pytest.skip(f"no overlay of this machine: {error}")
    write_program(tmp_path / "sudo", 'exec "$@"')
    (clone / "image").mkdir()

    def typed(line: str) -> str:
        path = f"{tmp_path}:/usr/bin:/bin:/usr/sbin:/sbin"
        environment = {"PATH": path, "HOME": str(tmp_path), **pip_variables()}
        words = root.on_host(f"cd '{clone}'; {line}", environment)
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=400)
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        return done.stdout

    try:
        typed(f"mount --bind '{root.root}' image; mkdir -p image/usr/src; rm -rf image/etc/shmmap")
        copy, install, units = read_page("systemd/README.md").commands("image-program")
        typed(copy)
        with index_or_skip():
            typed(install)
        typed(units)
        unit = typed("cat image/etc/systemd/system/shmmapd.service")
        assert "\nExecStart=/opt/shmmap/bin/shmmapd " in unit
    finally:
        root.close()
