# SPDX-License-Identifier: Apache-2.0
"""Public names: few in ``shmmap``, the rest in its public packages; every one is there."""

from __future__ import annotations

import importlib
import inspect
import py_compile
import pydoc
import re
import sys
from pathlib import Path

import pytest

import shmmap
from shmmap import errors

PACKAGES = ("errors", "events", "layers", "live")


def test_every_name_that_dir_lists_is_there() -> None:
    names = dir(shmmap)
    assert len(names) <= 40
    for name in names:
        assert getattr(shmmap, name) is not None


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'conect'$"):
        shmmap.conect  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("package", PACKAGES)
def test_a_name_of_a_public_package_is_found(package: str) -> None:
    """The error says where a name is that is looked for in ``shmmap``."""
    module = importlib.import_module(f"shmmap.{package}")
    for name in set(module.__all__) - set(dir(shmmap)):
        with pytest.raises(AttributeError, match=rf"it is shmmap\.{package}\.{name}$"):
            getattr(shmmap, name)


def test_all_errors_are_public() -> None:
    tree = {
        name for name, kind in vars(errors).items() if inspect.isclass(kind) and issubclass(kind, Exception)
    }
    assert tree <= set(errors.__all__)
    for name in dir(shmmap):
        value = getattr(shmmap, name)
        if inspect.isclass(value) and issubclass(value, BaseException):
            assert value is getattr(errors, name)


def test_help_is_a_page_or_two() -> None:
    """It names every public name, and first what a user needs first."""
    text = pydoc.plain(pydoc.render_doc(shmmap))
    assert text.count("\n") < 400
    described = text.partition("PACKAGE CONTENTS")[0]
    assert set(re.findall(r"`(?:shmmap\.)?(\w+)`", described)) >= set(dir(shmmap)) - {"__version__"}
    first = described.index("::")
    for name in ("connect", "Client", "Circle", "Box", "Cell", "MapWindow"):
        assert f"`{name}`" in described[:first]


# --- names of a package that are loaded when they are first used ------------------------------------------


PACKAGE = """\
from typing import TYPE_CHECKING

from shmmap.lazy_imports import lazy_names

if TYPE_CHECKING:
    from lazy_one.inner import first, second
    from lazy_one.broken import third

__all__ = ["first", "second", "third"]

__getattr__ = lazy_names(__name__)
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    root = tmp_path / "lazy_one"
    root.mkdir()
    (root / "__init__.py").write_text(PACKAGE)
    (root / "inner.py").write_text("first, second, other = 1, 2, 3\n")
    (root / "broken.py").write_text("import no_such_package_anywhere\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("lazy_one", "lazy_one.inner", "lazy_one.broken"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return root


def test_a_name_is_loaded_when_it_is_first_used(package: Path) -> None:
    loaded = importlib.import_module("lazy_one")
    assert "lazy_one.inner" not in sys.modules
    assert loaded.second == 2
    assert vars(loaded)["second"] == 2, "and stands in the package then"
    assert loaded.first == 1
    with pytest.raises(ModuleNotFoundError, match="no_such_package_anywhere"):
        _ = loaded.third
    for name in ("other", "lazy_names_of_nothing"):
        with pytest.raises(AttributeError, match=f"module 'lazy_one' has no attribute '{name}'"):
            getattr(loaded, name)


def test_a_package_without_its_source_says_so(package: Path) -> None:
    for path in package.glob("*.py"):
        py_compile.compile(str(path), cfile=str(path.with_suffix(".pyc")))
        path.unlink()
    importlib.invalidate_caches()
    loaded = importlib.import_module("lazy_one")
    with pytest.raises(ImportError, match="lazy_one is installed without its source"):
        _ = loaded.first
