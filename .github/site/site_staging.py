# SPDX-License-Identifier: Apache-2.0
"""Lay the pages out for Sphinx: tracked pages and pictures in a directory, with links that hold there.

A page keeps its place, but README.md becomes ``index.md``, and what lies below ``.github`` moves up: the
pages host serves nothing whose name begins with a dot.  A link to a file that is no page leads to a page
that shows the file; a link to a folder to a list of its files.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path, PurePosixPath
from typing import Final

from site_contents import HERE, SECTIONS

_LINK: Final = re.compile(r"(\]\()([^)\s]+)(\))")
_FENCED: Final = re.compile(r"^(```.*?^```$)", re.MULTILINE | re.DOTALL)
_PICTURES: Final = (".svg", ".png")
_BESIDE: Final = (
    "---\norphan: true\nnosearch: true\n---\n\n"  # in no list, and not found by the site's search
)
_LEXERS: Final = {
    ".py": "python",
    ".hpp": "cpp",
    ".cpp": "cpp",
    ".yml": "yaml",
    ".toml": "toml",
    ".ipynb": "json",
}


def tracked_files(root: Path) -> list[str]:
    """Return the files that git has or would take, as they stand on disk, relative to ``root``."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=root,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    return sorted(name for name in listed.split("\0") if name and (root / name).is_file())


def place(name: str) -> str:
    """Return where a file of the repository is in the staged tree."""
    if name == "README.md":
        return "index.md"
    return name.removeprefix(f"{HERE}/").removeprefix(".github/")


class Tree:
    """The staged tree.

    Parameters
    ----------
    root
        The repository.
    out
        The directory, which is made.
    """

    def __init__(self, root: Path, out: Path) -> None:
        self.root, self.out = root, out
        self.files = tracked_files(root)
        self._shown: set[str] = set()

    def write(self, name: str, text: str) -> None:
        """Write a page or another text of the tree."""
        path = self.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

    def page(self, name: str) -> str:
        """Return the text of a page of the repository, with its links as they are in the tree."""
        parts = _FENCED.split((self.root / name).read_text(encoding="utf-8"))
        parts[::2] = [_LINK.sub(lambda link: self._moved(name, link), prose) for prose in parts[::2]]
        return "".join(parts)

    def _moved(self, page: str, link: re.Match[str]) -> str:
        path, mark, anchor = link[2].partition("#")
        if "://" in link[2] or not path:
            return link[0]
        target = os.path.normpath(str(PurePosixPath(page).parent / path))
        if (self.root / target).is_dir():
            staged = self._list(target)
        elif not (self.root / target).is_file():
            return link[0]  # Sphinx reports it
        elif target.endswith((".md", *_PICTURES)):
            staged = place(target)
        else:
            staged = self._show(target)
        there = os.path.relpath(staged, PurePosixPath(place(page)).parent)
        return f"{link[1]}{there}{mark}{anchor}{link[3]}"

    def _show(self, name: str) -> str:
        """Make a page with the text of a file; return where it is."""
        staged = f"files/{name.lstrip('.')}.md"
        if name not in self._shown:
            self._shown.add(name)
            text = (self.root / name).read_text(encoding="utf-8")
            lexer = _LEXERS.get(PurePosixPath(name).suffix, "text")
            self.write(staged, f"{_BESIDE}# {name}\n\n`````{lexer}\n{text}`````\n")
        return staged

    def _list(self, folder: str) -> str:
        """Make a page that lists the files of a folder; return where it is."""
        staged = f"files/{folder.lstrip('.')}/index.md"
        if folder not in self._shown:
            self._shown.add(folder)
            lines = []
            for name in self.files:
                if PurePosixPath(name).parent == PurePosixPath(folder):
                    there = os.path.relpath(self._show(name), PurePosixPath(staged).parent)
                    lines.append(f"- [{PurePosixPath(name).name}]({there})\n")
            self.write(staged, f"{_BESIDE}# {folder}\n\n{''.join(lines)}")
        return staged


def stage(root: Path, out: Path) -> Tree:
    """Stage all pages and pictures; the first page gets the list of sections."""
    tree = Tree(root, out)
    for name in tree.files:
        if name.endswith(".md"):
            tree.write(place(name), tree.page(name))
        elif name.endswith(_PICTURES):
            path = out / place(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / name, path)
    with (out / "index.md").open("a", encoding="utf-8") as index:
        index.write(sections(tree.files))
    return tree


def sections(files: list[str]) -> str:
    """Return the table of contents of the first page; pages that are not there yet are left out."""
    return "".join(
        toctree([place(page) for page in pages if page in files or not page.endswith(".md")], caption)
        for caption, pages in SECTIONS.items()
    )


def toctree(pages: list[str], caption: str = "") -> str:
    """Return a list of pages: in the text, or, with a caption, beside it alone."""
    options = f":caption: {caption}\n:hidden:\n" if caption else ""
    return "\n".join(["", "```{toctree}", f"{options}:maxdepth: 1", "", *pages, "```", ""])
