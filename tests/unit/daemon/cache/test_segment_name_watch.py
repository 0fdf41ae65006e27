# SPDX-License-Identifier: Apache-2.0
"""A name that vanishes is heard of, where it is one of ours."""

from __future__ import annotations

import os
import select
from pathlib import Path

from shmmap.daemon.cache.segment_name_watch import SegmentNameWatch
from shmmap.segment.directory import ShmDirectory

NAME = "/shmmap.unit.0011223344556677"


def test_names_that_vanish_are_told(shm: ShmDirectory) -> None:
    fd = shm.create()
    shm.link(fd, NAME)
    os.close(fd)
    names = SegmentNameWatch(shm.path, "/shmmap.unit.")
    assert names.gone() == set()
    Path(shm.path, "shmmap.other.1").write_bytes(b"")
    Path(shm.path, "shmmap.other.1").unlink()
    shm.rename(NAME, NAME + ".zombie")
    shm.unlink(NAME + ".zombie")
    assert select.select([names.fd], [], [], 10.0)[0]
    assert names.gone() == {NAME, NAME + ".zombie"}
    names.close()
