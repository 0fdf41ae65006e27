# SPDX-License-Identifier: Apache-2.0
"""The peers of ``tests/support/dds_peers``, compiled where what they need is installed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

__all__ = ["built_cyclone_peer", "built_fast_peer"]

_SOURCES = Path(__file__).parent / "dds_peers"


def built_cyclone_peer(folder: Path) -> Path | None:
    """The peer over Debian's CycloneDDS; None where it cannot be built."""
    if not (shutil.which("idlc") and shutil.which("gcc") and Path("/usr/include/dds/dds.h").exists()):
        return None
    # -t: no type information, as in the ROS distributions whose mapping this is
    subprocess.run(["idlc", "-t", "-l", "c", str(_SOURCES / "autoware.idl")], cwd=folder, check=True)
    program = folder / "cyclone_peer"
    sources = [str(_SOURCES / "cyclone_peer.c"), "autoware.c"]
    subprocess.run(
        ["gcc", "-O1", "-Wall", "-Wextra", "-Werror", "-I.", *sources, "-lddsc", "-o", str(program)],
        cwd=folder,
        check=True,
    )
    return program


def built_fast_peer(folder: Path) -> Path | None:
    """The peer over Fast DDS; None where it cannot be built."""
    if not (shutil.which("g++") and Path("/usr/include/fastdds/dds/topic/TopicDataType.hpp").exists()):
        return None
    program = folder / "fast_peer"
    flags = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror"]
    source = str(_SOURCES / "fast_peer.cpp")
    subprocess.run(["g++", *flags, source, "-lfastrtps", "-lfastcdr", "-o", str(program)], check=True)
    return program
