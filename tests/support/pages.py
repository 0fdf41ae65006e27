# SPDX-License-Identifier: Apache-2.0
"""Pages of the repository as their readers use them: named blocks of commands and programs, and links."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tests.support.daemon_process import ROOT

__all__ = ["Page", "all_pages", "heading_anchor", "read_page"]

_BLOCK = re.compile(r"^<!-- ([\w-]+) -->\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\(([^)\s]+)\)")


@dataclass(frozen=True)
class Page:
    """One Markdown file."""

    path: Path
    text: str

    @property
    def blocks(self) -> dict[str, list[str]]:
        """Lines of each fenced block that follows a comment ``<!-- name -->``."""
        found = _BLOCK.findall(self.text)
        assert len(found) == len(dict(found)), f"{self.path}: two blocks of one name"
        return {name: code.splitlines() for name, code in found}

    def commands(self, name: str) -> list[str]:
        """Commands of a block: no empty lines and comments, ends of continued lines joined."""
        joined = "\n".join(self.blocks[name]).replace("\\\n", " ")
        return [line for line in joined.splitlines() if line.strip() and not line.startswith("#")]

    @property
    def fences(self) -> int:
        """How many blocks of commands or programs there are, with a name or without."""
        return len(re.findall(r"^```(?:sh|python|cpp)$", self.text, re.MULTILINE))

    @property
    def links(self) -> list[str]:
        """Targets of all links and pictures."""
        return _LINK.findall(self.text)

    @property
    def anchors(self) -> set[str]:
        """Anchors that the page's headings have where it is shown."""
        prose = re.sub(r"^```.*?^```$", "", self.text, flags=re.MULTILINE | re.DOTALL)
        return {heading_anchor(title) for title in re.findall(r"^#+ (.+)$", prose, re.MULTILINE)}


def heading_anchor(title: str) -> str:
    """Return a heading's anchor: lower case, blanks as hyphens, no other signs."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def read_page(name: str) -> Page:
    """Return the page at a path relative to the repository."""
    path = ROOT / name
    return Page(path, path.read_text(encoding="utf-8"))


def all_pages() -> list[str]:
    """Return every page of the repository: paths relative to it."""
    folders = (".github", "clients", "shmmap", "systemd", "tests")
    found = [path for folder in folders for path in (ROOT / folder).rglob("*.md")]
    return sorted(str(path.relative_to(ROOT)) for path in [*ROOT.glob("*.md"), *found])
