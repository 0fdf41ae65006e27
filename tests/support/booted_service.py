# SPDX-License-Identifier: Apache-2.0
"""An environment of a booted machine's service, and wheels of this tree for it."""

from __future__ import annotations

import sys
import sysconfig
import zipfile
from pathlib import Path

import shmmap
from tests.support.booted_systemd import BootedSystemd
from tests.support.daemon_process import ROOT


def make_wheel(directory: Path, version: str) -> Path:
    """Make a wheel of this tree under another number; a build would need a network."""
    built, about = directory / f"shmmap-{version}-py3-none-any.whl", f"shmmap-{version}.dist-info"
    folders = {"shmmap": "shmmap", "clients/shmmap_clients": "shmmap_clients", "systemd": "shmmap/_systemd"}
    texts = {
        f"{about}/METADATA": f"Metadata-Version: 2.1\nName: shmmap\nVersion: {version}\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{about}/entry_points.txt": "[console_scripts]\nshmmap = shmmap.cli:main\n"
        "shmmapd = shmmap.cli:serve_main\n",
    }
    for folder, inside in folders.items():
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                texts[f"{inside}/{path.relative_to(ROOT / folder)}"] = path.read_text(encoding="utf-8")
    file = "shmmap/version.py"
    texts[file] = texts[file].replace(f'"{shmmap.__version__}"', f'"{version}"')
    texts[f"{about}/RECORD"] = "".join(f"{name},,\n" for name in [*texts, f"{about}/RECORD"])
    with zipfile.ZipFile(built, "w") as archive:
        for name, text in texts.items():
            archive.writestr(name, text)
    return built


def pip_install(machine: BootedSystemd, built: Path, place: str) -> None:
    """``pip install`` a wheel into the environment of the service."""
    pip = f"{sys.executable} -m pip --python {place}/bin/python install -q --no-deps --no-index"
    machine.shell(f"unset PYTHONPATH; {pip} /exchange/{built.name} 2>&1")


def make_environment(machine: BootedSystemd, place: str) -> None:
    """Make an environment for the service, with the packages of this one."""
    packages = sysconfig.get_path("purelib")
    machine.shell(f"""
        unset PYTHONPATH
        {sys.executable} -m venv --without-pip {place}
        echo {packages} >"$({place}/bin/python -c 'import site; print(site.getsitepackages()[0])')/others.pth"
    """)
