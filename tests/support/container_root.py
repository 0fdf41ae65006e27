# SPDX-License-Identifier: Apache-2.0
"""What `docker build` and `docker compose` would do, with namespaces: no runtime, but the same steps.

The image is a throw-away overlay of this machine, in which ``python3`` is this Python.  Each container has
mounts, processes and /dev/shm of its own.  Read are the instructions and keys that our files use; any other
one is an error, so that nothing is silently left out.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

STEP_S = 400.0

OVERLAY = r"""
set -eu
X=$1
mount -t tmpfs -o mode=755 tmpfs "$X"
mkdir "$X/upper" "$X/work" "$X/root" "$X/volumes"
mount -t overlay overlay -o "lowerdir=/,upperdir=$X/upper,workdir=$X/work" "$X/root" || exit 77
R=$X/root
above=$2
while above=$(dirname "$above"); [ "$above" != / ]; do chmod a+x "$R$above"; done
for place in tmp run home; do mount -t tmpfs -o mode=1777 tmpfs "$R/$place"; done
mount -t tmpfs -o mode=755 tmpfs "$R/dev"
for node in null zero random urandom; do : >"$R/dev/$node"; mount --bind "/dev/$node" "$R/dev/$node"; done
mkdir "$R/dev/shm"
echo made
read -r _
"""

ENTER = r"""
set -eu
R=$1; owner=$2; groups=$3; ipc=$4; volumes=$5; shift 5
mount -t proc proc "$R/proc"
if [ "$ipc" = host ]; then mount --bind /dev/shm "$R/dev/shm"
else mount -t tmpfs -o mode=1777,size=64m tmpfs "$R/dev/shm"; fi
echo "$volumes" | while read -r from to how; do
    [ -n "$from" ] || continue
    mkdir -p "$R$to"; mount --rbind "$from" "$R$to"
    [ "$how" != ro ] || mount -o remount,bind,ro "$R$to"
done
exec chroot --userspec="$owner" ${groups:+--groups="$groups"} "$R" env -i "$@"
"""


@dataclass
class Image:
    """A Dockerfile: steps in order, and what containers begin with."""

    base: str = ""
    steps: list[tuple[str, str]] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=dict)
    user: str = "root"
    command: list[str] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> Image:
        """Read a Dockerfile."""
        image = cls()
        text = re.sub(r"^#.*\n", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
        for line in text.replace("\\\n", " ").splitlines():
            word, _, rest = line.strip().partition(" ")
            if word == "FROM":
                image.base = rest
            elif word in ("RUN", "COPY"):
                assert image.user == "root", "steps after USER are not run here"
                image.steps.append((word, rest))
            elif word == "ENV":
                image.environment |= dict(one.split("=", 1) for one in shlex.split(rest))
            elif word == "USER":
                image.user = rest
            elif word == "CMD":
                image.command = json.loads(rest)
            else:
                assert not word, f"an instruction that is not known here: {word}"
        return image


class ContainerRoot:
    """Builds an image in the constructor; closed, everything is gone.

    Parameters
    ----------
    place
        Empty directory of the build.
    context
        What ``COPY`` copies from; only files that git knows, as ``.dockerignore`` leaves out the others.

    Raises
    ------
    OSError
        This machine does not allow it.
    """

    def __init__(self, place: Path, image: Image, context: Path, files: Sequence[str]) -> None:
        self.image, self.root, self._place = image, place / "root", place
        python = os.path.realpath(getattr(sys, "_base_executable", sys.executable))
        self._path = f"{os.path.dirname(python)}:/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin"
        self._holder = subprocess.Popen(
            ["unshare", "--mount", "--propagation", "private", "sh", "-c", OVERLAY, "sh", place, python],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout is not None
        assert self._holder.stderr is not None
        if self._holder.stdout.readline() != "made\n":
            why = self._holder.stderr.read().strip()
            self.close()
            raise OSError(why)
        for word, rest in image.steps:
            if word == "COPY":
                source, target = rest.split()
                assert source == "."
                self._copy(context, files, target)
            else:
                done = self.run(["sh", "-c", rest], user="root", environment=pip_variables())
                assert done.returncode == 0, f"RUN {rest}\n{done.stderr}"

    def _copy(self, context: Path, files: Sequence[str], target: str) -> None:
        place = f"{self.root}{target}"
        words = ["sh", "-c", 'mkdir -p "$1" && tar -C "$2" --null -T - -cf - | tar -C "$1" -xf -', "sh"]
        listed = "\0".join(files).encode()
        subprocess.run([*self._inside(), *words, place, context], input=listed, check=True, timeout=STEP_S)

    def _inside(self) -> list[str]:
        return ["nsenter", f"--mount=/proc/{self._holder.pid}/ns/mnt"]

    def prepare_volume(self, name: str, options: str = "") -> str:
        """Make a volume, a tmpfs where it has mount options; return its directory."""
        place = f"{self._place}/volumes/{name}"
        mount = f' && mount -t tmpfs -o "{options}" tmpfs {place}' if options else f" && chmod 1777 {place}"
        subprocess.run([*self._inside(), "sh", "-c", f"mkdir {place}{mount}"], check=True)
        return place

    def _words(
        self,
        command: Sequence[str],
        user: str,
        environment: Mapping[str, str],
        volumes: Sequence[tuple[str, str, str]],
        groups: Sequence[str] = (),
        ipc: str = "private",
    ) -> list[str]:
        listed = "\n".join(" ".join(one) for one in volumes)
        given = {"PATH": self._path, "HOME": "/tmp", **environment}
        return [
            *self._inside(),
            *("unshare", "--mount", "--pid", "--ipc", "--fork", "--kill-child", "--propagation", "private"),
            *("sh", "-c", ENTER, "sh", str(self.root), self._owner(user), ",".join(groups), ipc, listed),
            *(f"{name}={value}" for name, value in given.items()),
            *command,
        ]

    def _owner(self, user: str) -> str:
        if user == "root":
            return "0:0"
        if user.isdecimal():
            return f"{user}:0"
        done = subprocess.run(
            [*self._inside(), "chroot", self.root, "getent", "passwd", user],
            check=True,
            capture_output=True,
            text=True,
        )
        return ":".join(done.stdout.split(":")[2:4])

    def run(
        self,
        command: Sequence[str],
        *,
        user: str = "",
        environment: Mapping[str, str] | None = None,
        volumes: Sequence[tuple[str, str, str]] = (),
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in a container of its own to its end."""
        words = self._words(command, user or self.image.user, environment or self.image.environment, volumes)
        return subprocess.run(words, capture_output=True, text=True, check=False, timeout=STEP_S)

    def on_host(self, script: str, environment: Mapping[str, str] | None = None) -> list[str]:
        """Return the command that runs lines as root outside of containers, with the mounts of the image."""
        given = [f"{name}={value}" for name, value in (environment or {}).items()]
        path = f"PATH={(environment or {}).get('PATH', self._path)}"
        return [*self._inside(), "env", "-i", path, *given, "bash", "-euc", script]

    def docker_run(self, line: str, *command: str) -> subprocess.CompletedProcess[str]:
        """Run a command in a container as ``docker run ... IMAGE`` says; other options are an error."""
        script = f"docker() {{ printf '%s\\n' \"$@\"; }}; {line}"
        verb, *words = subprocess.run(
            self.on_host(script), check=True, capture_output=True, text=True
        ).stdout.splitlines()
        assert (verb, words.pop()) == ("run", "IMAGE"), line
        parser = argparse.ArgumentParser(exit_on_error=False)
        parser.add_argument("-v", action="append", default=[])
        parser.add_argument("-e", action="append", default=[])
        parser.add_argument("--user", default="root")
        parser.add_argument("--group-add", action="append", default=[])
        parser.add_argument("--ipc", default="private")
        given = parser.parse_args(words)
        volumes = [(*one.split(":"), "rw")[:3] for one in given.v]
        environment = {"PATH": self.image.environment["PATH"], **dict(one.split("=", 1) for one in given.e)}
        words = self._words(command, given.user, environment, volumes, given.group_add, given.ipc)
        return subprocess.run(words, capture_output=True, text=True, check=False, timeout=STEP_S)

    def start(
        self, command: Sequence[str], volumes: Sequence[tuple[str, str, str]], log: Path
    ) -> subprocess.Popen[bytes]:
        """Start a container in the background."""
        words = self._words(command, self.image.user, self.image.environment, volumes)
        with log.open("wb") as file:
            return subprocess.Popen(words, stdout=file, stderr=file)

    def close(self) -> None:
        """End what holds the root: its mounts go with it."""
        self._holder.kill()
        self._holder.communicate()


def pip_variables() -> dict[str, str]:
    """Return the variables of the environment that pip, and what it asks, read."""
    kept = {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
    names = ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY", "no_proxy", "SSL_CERT_FILE", "LANG")
    return kept | {name: os.environ[name] for name in names if name in os.environ}


def read_compose(path: Path) -> dict[str, Any]:
    """Read a compose file; keys that are not known here are an error."""
    found: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    known = {"image", "build", "command", "volumes", "healthcheck", "depends_on"}
    for service in found["services"].values():
        assert set(service) <= known, service
    return found
