# SPDX-License-Identifier: Apache-2.0
"""Pages say what is there: links lead somewhere, verbs and options exist, tables are whole."""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys

import pytest

from shmmap.cli.entry import build_parser
from tests.support.daemon_process import ROOT
from tests.support.pages import Page, all_pages, read_page

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PAGES = all_pages()
GUIDES = [name for name in PAGES if name != "CHANGELOG.md"]  # which is about the past


def options(parser: argparse.ArgumentParser) -> set[str]:
    """Return the options of a parser and of its actions, such as ``unit install``."""
    found: set[str] = set()
    for action in parser._actions:
        found.update(action.option_strings)
        if isinstance(action, argparse._SubParsersAction):
            found.update(*(options(one) for one in action.choices.values()))
    return found


VERBS = next(one.choices for one in build_parser()._actions if isinstance(one, argparse._SubParsersAction))


def typed(page: Page) -> list[str]:
    """Return what follows ``shmmap`` on each line of a page's blocks of commands."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", page.text.replace("\\\n", " "), re.MULTILINE | re.DOTALL)
    return _after_shmmap("\n".join(blocks).splitlines())


def mentioned(page: Page) -> list[str]:
    """Return what follows ``shmmap`` where the prose of a page names a command."""
    prose = re.sub(r"^```.*?^```$", "", page.text, flags=re.MULTILINE | re.DOTALL)
    return _after_shmmap(re.findall(r"`([^`\n]+)`", prose))


def _after_shmmap(lines: list[str]) -> list[str]:
    simple = (re.split(r"[|;#]|&&", line)[0].strip() for line in lines)
    bare = (re.sub(r"^(sudo (-u \w+ )?|docker run .* IMAGE )", "", line) for line in simple)
    return [match[1] for line in bare if (match := re.match(r"(?:/\S+/)?shmmap ([a-z].*)$", line))]


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name: str) -> None:
    page = read_page(name)
    for link in page.links:
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.path.parent / path).resolve() if path else page.path
        assert target.is_relative_to(ROOT), link
        assert target.exists(), link
        if anchor:
            assert anchor in read_page(str(target.relative_to(ROOT))).anchors, link


@pytest.mark.parametrize("name", GUIDES)
def test_typed_commands_are_understood(name: str) -> None:
    for command in typed(read_page(name)):
        assert callable(build_parser().parse_args(shlex.split(command)).run), command


@pytest.mark.parametrize("name", GUIDES)
def test_verbs_and_options_that_are_mentioned_exist(name: str) -> None:
    for command in mentioned(read_page(name)):
        verb, *words = command.split()
        assert verb in VERBS, command
        for word in words:
            if word.startswith("--"):
                assert word.split("=")[0] in options(VERBS[verb]), command


def test_commands_are_found() -> None:
    pages = [read_page(name) for name in GUIDES]
    assert {command.split()[0] for page in pages for command in typed(page)} >= {
        "serve", "status", "query", "divide", "unit", "doctor", "prepare", "demo",
    }  # fmt: skip
    assert {command.split()[0] for page in pages for command in mentioned(page)} >= {
        "config",
        "reload",
        "pin",
    }


@pytest.mark.parametrize("name", GUIDES)
def test_lines_and_tables_are_whole(name: str) -> None:
    """Each row of a table has as many cells as its head."""
    head = 0
    for line in read_page(name).text.splitlines():
        cells = len(re.findall(r"(?<!\\)\|", re.sub(r"`[^`]*`", "", line))) if line.startswith("|") else 0
        if cells and head:
            assert cells == head, line
        head = cells


def test_nothing_says_that_the_package_is_on_an_index() -> None:
    """It is installed from its source: `pip install shmmap` would find nothing or another package."""
    sources = [path for folder in ("shmmap", "clients") for path in (ROOT / folder).rglob("*.py")]
    for path in [*(ROOT / name for name in PAGES), *sources]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"pip3? install[^\n&|]*['\" ]shmmap(\[|['\"`\s])", text), path


def test_every_extra_has_its_packages_and_its_weight() -> None:
    """`python -m tests.benchmarks.extras_weight` measures it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    rows = re.findall(
        r"^\| `pip install (.*?)` \| (\d+) \| ", read_page("shmmap/INSTALL.md").text, re.MULTILINE
    )
    named = {tuple(sorted(shlex.split(packages))): int(megabytes) for packages, megabytes in rows}
    for extra, packages in project["optional-dependencies"].items():
        if extra not in ("test", "dev", "docs"):
            assert named.get(tuple(sorted(packages)), 0) > 0, extra


def test_the_small_installs_name_the_dependencies() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [re.split(r"[><=;]", one)[0] for one in project["dependencies"] if not one.startswith("open3d")]
    page = read_page("shmmap/INSTALL.md")
    for name, packages in (("slim", needed), ("client-only", needed[:4])):
        (line,) = page.commands(name)
        first, second = re.findall(r"pip install -q ([^&]+)", line)
        assert first.split() == packages, name
        assert second == "--no-deps ."


def test_what_readme_makes_is_not_offered_to_git() -> None:
    text = read_page("README.md").text
    made = re.findall(r"(?:--keep-map|-o) (\S+)", text)
    assert len(made) == 2
    if not (ROOT / ".git").exists():
        pytest.skip("this is no checkout")
    paths = [f"{name}/a.pcd" if name == "town" else name for name in made]
    done = subprocess.run(
        ["git", "check-ignore", *paths], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == paths
