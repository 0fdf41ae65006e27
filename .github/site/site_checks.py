# SPDX-License-Identifier: Apache-2.0
"""Look at the built site: links lead somewhere, nothing is loaded from elsewhere, the first page is light."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote, urlsplit

MAX_FIRST_PAGE_BYTES: Final = 1_000_000


class _Page(HTMLParser):
    """Links, anchors, and what is loaded for a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.anchors: set[str] = {""}
        self.loaded: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.add(given["href"])
        elif tag == "link" and given.get("rel") in ("stylesheet", "icon", "preload"):
            self.loaded.add(given["href"])
        elif "src" in given:
            self.loaded.add(given["src"])
        elif tag == "object" and "data" in given:
            self.loaded.add(given["data"])


def _local(page: Path, link: str) -> Path:
    return (page.parent / unquote(urlsplit(link).path)).resolve() if urlsplit(link).path else page


def loaded_bytes(page: Path) -> int:
    """Return the bytes of a page with all that it loads from the site, unpacked."""
    files = {_local(page, link) for link in _Page(page).loaded if not urlsplit(link).netloc} | {page}
    return sum(path.stat().st_size for path in files if path.is_file())


def check_site(out: Path) -> list[str]:
    """Return a line for each fault of the site in ``out``; links to other hosts are not followed."""
    pages = {path: _Page(path) for path in sorted(out.rglob("*.html"))}
    faults = []
    for path, page in pages.items():
        name = path.relative_to(out)
        for link in sorted(page.loaded):
            if urlsplit(link).netloc or urlsplit(link).scheme not in ("", "data"):
                faults.append(f"{name}: loads {link}")
            elif not link.startswith("data:") and not _local(path, link).is_file():
                faults.append(f"{name}: {link} is missing")
        for link in sorted(page.links):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = _local(path, link)
            if target.is_dir():
                target /= "index.html"
            if not target.is_file():
                faults.append(f"{name}: {link} leads nowhere")
            elif target in pages and unquote(parts.fragment) not in pages[target].anchors:
                faults.append(f"{name}: {link} has no such anchor")
    first = loaded_bytes(out / "index.html")
    if first > MAX_FIRST_PAGE_BYTES:
        faults.append(f"index.html: {first} bytes with all that it loads, more than {MAX_FIRST_PAGE_BYTES}")
    return faults


def found_by_search(out: Path, query: str) -> set[str]:
    """Return the pages, without suffix, that the site's search finds: each has all words of the query.

    As Sphinx's ``searchtools.js``: words are stemmed, and a word that no page has may be a part of one.
    """
    from sphinx.search.en import SearchEnglish

    text = (out / "searchindex.js").read_text(encoding="utf-8")
    index: dict[str, Any] = json.loads(text.removeprefix("Search.setIndex(").removesuffix(")"))
    english, tables = SearchEnglish({}), (index["terms"], index["titleterms"])

    def pages_with(word: str) -> set[int]:
        stem = english.stem(word)
        stems = [{stem}, {one for table in tables for one in table if len(word) > 2 and stem in one}]
        for tried in stems:
            numbers = [table[one] for table in tables for one in tried if one in table]
            if numbers:
                return {page for one in numbers for page in (one if isinstance(one, list) else [one])}
        return set()

    words = [word for word in re.findall(r"\w+", query.lower()) if word not in english.stopwords]
    found = set.intersection(*map(pages_with, words)) if words else set()
    return {index["docnames"][page] for page in found}


def check_searches(out: Path, searches: Mapping[str, str]) -> list[str]:
    """Return a line for each search that does not find its page."""
    return [
        f"search: {query!r} does not find {page}"
        for query, page in searches.items()
        if page not in found_by_search(out, query)
    ]
