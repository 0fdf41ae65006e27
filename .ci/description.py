# SPDX-License-Identifier: Apache-2.0
"""The wheel's description: README.md, with links that lead to the repository, as index pages have no files.

A metadata hook of hatchling.  ``repository`` in pyproject.toml is the one setting: the address of the
repository's front page; empty: it is not public, and links stay as they are.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)(\[[^]]*\])\((?![a-z][a-z0-9+.-]*:|#|/)([^)\s]+)\)")


def with_absolute_links(text: str, repository: str) -> str:
    """Return a page of the repository's root with links to the repository; pictures as raw files."""
    base = repository.rstrip("/")
    if not base:
        return text
    return _LINK.sub(
        lambda link: f"{link[1]}{link[2]}({base}/{'raw' if link[1] else 'blob'}/HEAD/{link[3]})", text
    )


class Description(MetadataHookInterface):
    """Gives the project its description and the address of its repository."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Add both."""
        repository = str(self.config.get("repository", ""))
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {
            "content-type": "text/markdown",
            "text": with_absolute_links(text, repository),
        }
        metadata["urls"] = {"Repository": repository} if repository else {}
