# SPDX-License-Identifier: Apache-2.0
"""The documentation site: every page and public name is in it, staged links lead somewhere, faults are found.

Sphinx itself is run by ``.ci/run``: ``python .github/site OUT``.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import sys
from pathlib import Path

import pytest
import site_contents
import site_staging
from site_checks import check_searches, check_site
from site_reference import add_reference, help_text

import shmmap
from tests.support.daemon_process import ROOT
from tests.support.pages import Page

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@pytest.fixture(scope="module")
def staged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the staged tree, with the pages that are made from code."""
    if not (ROOT / ".git").exists():
        pytest.skip("this tree is no checkout: git does not say what belongs to it")
    out = tmp_path_factory.mktemp("site")
    add_reference(site_staging.stage(ROOT, out))
    return out


def pages_of(folder: Path) -> dict[Path, Page]:
    return {path: Page(path, path.read_text(encoding="utf-8")) for path in folder.rglob("*.md")}


def test_every_page_is_in_a_section(staged: Path) -> None:
    listed = [page for pages in site_contents.SECTIONS.values() for page in pages]
    assert len(listed) == len(set(listed))
    tracked = {name for name in site_staging.tracked_files(ROOT) if name.endswith(".md")}
    assert tracked - set(listed) == {"README.md"}
    for name in listed:
        place = staged / site_staging.place(name)
        assert place.with_suffix(".md").is_file() or name not in tracked


def test_every_public_name_is_described() -> None:
    modules = {page.module for page in site_contents.API}
    described = [
        getattr(importlib.import_module(page.module), name)
        for page in site_contents.API
        for name in page.described()
    ]
    assert all(page.described() for page in site_contents.API)
    for name in set(dir(shmmap)) - {"__version__"}:
        value = getattr(shmmap, name)
        if inspect.ismodule(value):
            assert value.__name__ in modules
        else:
            assert any(value is one for one in described), name
    for path in (ROOT / "clients" / "shmmap_clients").glob("*/__init__.py"):
        if "__all__" in path.read_text(encoding="utf-8"):
            assert f"shmmap_clients.{path.parent.name}" in modules


def test_every_program_has_its_help(staged: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(project["scripts"]) - {"shmmap", "shmmapd"} == set(site_contents.PROGRAMS)
    text = (staged / "command-line/programs.md").read_text(encoding="utf-8")
    for name in site_contents.PROGRAMS:
        assert f"usage: {name} " in text
    assert "usage: shmmap-ndt follow " in text
    assert "usage: shmmap live export " in (staged / "command-line/live-maps.md").read_text(encoding="utf-8")


def test_staged_links_lead_somewhere(staged: Path) -> None:
    pages = pages_of(staged)
    assert (staged / "index.md") in pages
    shown = 0
    for path, page in pages.items():
        assert not any(part.startswith(".") for part in path.relative_to(staged).parts), "not uploaded"
        for link in Page(path, re.sub(r"^(`{3,}).*?^\1$", "", page.text, flags=re.M | re.S)).links:
            if "://" in link:
                continue
            target, _, anchor = link.partition("#")
            file = (path.parent / target).resolve() if target else path
            assert file.is_file(), f"{path}: {link}"
            if anchor:
                assert anchor in pages[file].anchors, f"{path}: {link}"
            shown += "files/" in target
    assert shown > 10, "pages link files"


def typed(page: Page) -> list[list[str]]:
    """Return the words of each command of another program than ``shmmap`` that a page has."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", page.text.replace("\\\n", " "), re.M | re.S)
    prose = re.sub(r"^```.*?^```$", "", page.text, flags=re.M | re.S)
    lines = [*"\n".join(blocks).splitlines(), *re.findall(r"`([^`\n]+)`", prose)]
    simple = [re.split(r"[|;#>]|&&", line)[0].split() for line in lines]
    return [words for words in simple if words and words[0] in site_contents.PROGRAMS]


def test_commands_of_the_other_programs_are_understood() -> None:
    """Each option that a page uses stands in the help of the program, or of its verb."""
    seen = set()
    for name in site_staging.tracked_files(ROOT):
        if not name.endswith(".md") or name == "CHANGELOG.md":
            continue
        for words in typed(Page(ROOT / name, (ROOT / name).read_text(encoding="utf-8"))):
            verb = [word for word in words[1:2] if re.fullmatch(r"[a-z-]*[a-z]", word) and word[0] != "-"]
            text = help_text(words[0], importlib.import_module(site_contents.PROGRAMS[words[0]]).main, *verb)
            for word in words[: words.index("--ros-args")] if "--ros-args" in words else words:
                if word.startswith("--"):
                    option = re.split(r"[=\[]", word)[0]
                    assert re.search(rf"{option}[ ,\]=\n]", text), f"{name}: {' '.join(words)}"
            seen.add(" ".join([words[0], *verb]))
    assert seen >= {"shmmap-ndt follow", "shmmap-pose-init", "shmmap-rolling run", "shmmap-ros-node"}


def test_programs_on_pages_are_python() -> None:
    for name in site_staging.tracked_files(ROOT):
        if name.endswith(".md"):
            text = (ROOT / name).read_text(encoding="utf-8")
            for block in re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S):
                compile(block, name, "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)  # as in a notebook


GOOD = '<a id="top" href="other.html#here">x</a><img src="_images/a.svg"><script src="a.js"></script>'


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (GOOD, ""),
        ('<a href="gone.html">x</a>', "index.html: gone.html leads nowhere"),
        ('<a href="other.html#gone">x</a>', "index.html: other.html#gone has no such anchor"),
        ('<a href="#gone">x</a>', "index.html: #gone has no such anchor"),
        ('<script src="https://cdn.example/a.js"></script>', "index.html: loads https://cdn.example/a.js"),
        ('<link rel="stylesheet" href="//fonts.example/a.css">', "index.html: loads //fonts.example/a.css"),
        ('<img src="gone.png">', "index.html: gone.png is missing"),
        ("x" * 1_000_001, "index.html: 1000001 bytes with all that it loads, more than 1000000"),
        ('<a href="https://elsewhere.example/">x</a>', ""),
    ],
)
def test_faults_of_a_site_are_found(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "_images").mkdir()
    (tmp_path / "_images" / "a.svg").write_text("<svg/>")
    (tmp_path / "a.js").write_text("")
    (tmp_path / "other.html").write_text('<p id="here">x</p>')
    (tmp_path / "index.html").write_text(text)
    assert check_site(tmp_path) == ([fault] if fault else [])


def test_a_search_that_finds_nothing_is_found(tmp_path: Path) -> None:
    """The index is as Sphinx writes it: stems, and the pages that have them; one alone is no list."""
    pytest.importorskip("sphinx", reason="the extra docs is not installed")
    index = {
        "docnames": ["index", "layers"],
        "terms": {"unit": [0, 1], "inverse_covari": 1, "intens": 0},
        "titleterms": {"layer": 1},
    }
    (tmp_path / "searchindex.js").write_text(f"Search.setIndex({json.dumps(index)})")
    good = ("Layers", "units", "the units of layers", "covari units")
    bad = ("intensity units", "asyncio", "")
    assert check_searches(tmp_path, dict.fromkeys((*good, *bad), "layers")) == [
        f"search: {query!r} does not find layers" for query in bad
    ]
