# SPDX-License-Identifier: Apache-2.0
"""Look into the wheel and the source distribution: every file that belongs there, and no other.

``python tests/process/distributions.py DIRECTORY``, which ``python -m build`` has filled from this tree;
what belongs there is what git would commit, as it stands on disk.  Exit code 0 if all is well.
"""

from __future__ import annotations

import email.message
import email.parser
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from shmmap import __version__

ROOT = Path(__file__).resolve().parents[2]
NAME = f"shmmap-{__version__}"
SOURCE = (
    "shmmap/",
    "clients/",
    "tests/",
    "systemd/",
    ".github/",
    ".ci/",
)  # folders of the source distribution
TOP = {"README.md", "CHANGELOG.md", "LICENSE", "pyproject.toml", ".gitignore"}
WHEEL = {
    "shmmap/": "shmmap/",
    "clients/shmmap_clients/": "shmmap_clients/",
    "clients/cpp/include/": "shmmap/_cpp/include/",
    "clients/cpp/share/": "shmmap/_cpp/share/",
    "systemd/": "shmmap/_systemd/",
}
ABOUT = {"METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"}
# named one by one, so that the lists above cannot lose them together with the tree
NEEDED = {
    "shmmap/py.typed",
    "shmmap_clients/py.typed",
    "shmmap/INSTALL.md",
    "shmmap/CONTAINERS.md",
    "shmmap/protocol/PROTOCOL.md",
    "shmmap/segment/LAYOUT.md",
    "shmmap/_cpp/include/shmmap/shmmap.hpp",
    "shmmap/_cpp/share/cmake/shmmap/shmmapConfig.cmake",
    "shmmap/_cpp/share/cmake/shmmap/shmmapConfigVersion.cmake",
    "shmmap/_cpp/share/pkgconfig/shmmap.pc",
    "shmmap/_systemd/README.md",
    "shmmap/_systemd/shmmap.toml",
    "shmmap/_systemd/system/shmmapd.service",
}
PROGRAMS = {
    *("shmmap", "shmmapd", "shmmap-ndt", "shmmap-pose-init", "shmmap-compare", "shmmap-elevation"),
    "shmmap-rolling",
}

LINK = re.compile(r"\]\(([^)\s]+)\)")


def tree() -> set[str]:
    """Return the files that git would commit, relative to the repository."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split("\0")
    return {name for name in listed if name and (ROOT / name).is_file()}


def compared(what: str, found: set[str], wanted: set[str]) -> list[str]:
    """Return a line for each file that is too much or missing."""
    return [f"{what}: {name} does not belong there" for name in sorted(found - wanted)] + [
        f"{what}: {name} is missing" for name in sorted(wanted - found)
    ]


def description_faults(about: email.message.Message) -> list[str]:
    """Return what is wrong with the description: the README, with whole links if the repository has one."""
    text, readme = str(about.get_payload()), (ROOT / "README.md").read_text(encoding="utf-8")
    faults = [] if LINK.sub("", text).strip() == LINK.sub("", readme).strip() else ["it is not the README"]
    url = (about["Project-URL"] or "").removeprefix("Repository, ")
    for link, original in zip(LINK.findall(text), LINK.findall(readme), strict=False):
        if link != original and not (url and link.startswith(url) and link.endswith(f"/HEAD/{original}")):
            faults.append(f"the link {original} became {link}")
        elif url and "://" not in link:
            faults.append(f"the link {link} leads nowhere")
    return faults


def wheel_faults(wheel: Path, files: set[str]) -> list[str]:
    """Return what is wrong with the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        found = set(archive.namelist())
        about = email.parser.Parser().parsestr(archive.read(f"{NAME}.dist-info/METADATA").decode())
        programs = {
            line.split(" = ")[0]
            for line in archive.read(f"{NAME}.dist-info/entry_points.txt").decode().splitlines()
            if " = shmmap" in line
        }
    wanted = {f"{NAME}.dist-info/{name}" for name in ABOUT}
    for folder, inside in WHEEL.items():
        wanted |= {inside + name.removeprefix(folder) for name in files if name.startswith(folder)}
    faults = compared(wheel.name, found, wanted) + compared(wheel.name, found & NEEDED, NEEDED)
    if (about["Name"], about["Version"], about["License-Expression"]) != (
        "shmmap",
        __version__,
        "Apache-2.0",
    ):
        faults.append(f"{wheel.name}: another name, version or licence in its METADATA")
    faults += [f"{wheel.name}: {fault}" for fault in description_faults(about)]
    return faults + compared(f"{wheel.name}, programs", programs & PROGRAMS, PROGRAMS)


def source_faults(source: Path, files: set[str]) -> list[str]:
    """Return what is wrong with the source distribution."""
    with tarfile.open(source) as archive:
        found = {
            member.name.removeprefix(f"{NAME}/") for member in archive.getmembers() if not member.isdir()
        }
    wanted = {name for name in files if name.startswith(SOURCE) or name in TOP} | {"PKG-INFO"}
    return compared(source.name, found, wanted) + compared(source.name, found & TOP, TOP)


def main() -> None:
    """Look, and say."""
    folder = Path(sys.argv[1])
    wheel, source = folder / f"{NAME}-py3-none-any.whl", folder / f"{NAME}.tar.gz"
    built = {path.name for path in folder.iterdir()}
    faults = compared(str(folder), built, {wheel.name, source.name})
    if not faults:
        files = tree()
        faults = wheel_faults(wheel, files) + source_faults(source, files)
    if faults:
        raise SystemExit("\n".join(faults))
    print(
        f"{wheel.name} and {source.name}: {wheel.stat().st_size >> 10} and {source.stat().st_size >> 10} KiB"
    )


if __name__ == "__main__":
    main()
