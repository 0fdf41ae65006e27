# SPDX-License-Identifier: Apache-2.0
"""Names of a package that are loaded when they are first used; `shmmap`'s own: ``test_public_names``."""

from __future__ import annotations

import importlib
import py_compile
import sys
from pathlib import Path

import pytest

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
