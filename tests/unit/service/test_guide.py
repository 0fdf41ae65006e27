# SPDX-License-Identifier: Apache-2.0
"""The operator's guide names the files that are shipped (`test_pages` holds its commands)."""

from __future__ import annotations

import re

from shmmap.service.shipped_files import shipped_names
from tests.support.pages import read_page

GUIDE = read_page("systemd/README.md").text


def test_each_file_is_shipped_and_each_shipped_file_is_named() -> None:
    named = set(re.findall(r"`((?:system|user|drop-ins|sysusers\.d|tmpfiles\.d)/[^`/ ]+)`", GUIDE))
    named |= {"shmmap.toml"} if "`shmmap.toml`" in GUIDE else set()
    assert named == set(shipped_names()) - {"README.md"}
