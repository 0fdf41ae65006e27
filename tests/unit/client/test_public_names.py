# SPDX-License-Identifier: Apache-2.0
"""Public names: few in ``shmmap``, the rest in its public packages; every one is there."""

from __future__ import annotations

import importlib
import inspect
import pydoc
import re

import pytest

import shmmap
from shmmap import errors

PACKAGES = ("client", "errors", "events", "layers", "live")


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_of_a_package_is_there(package: str) -> None:
    module = importlib.import_module(f"shmmap.{package}")
    names: list[str] = module.__all__
    assert sorted(names) == sorted(set(names))
    for name in names:
        assert getattr(module, name) is not None


def test_every_name_that_dir_lists_is_there() -> None:
    names = dir(shmmap)
    assert len(names) <= 40
    for name in names:
        assert getattr(shmmap, name) is not None


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'conect'$"):
        shmmap.conect  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("package", PACKAGES[1:])
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
    for name in tree & set(dir(shmmap)):
        assert getattr(shmmap, name) is getattr(errors, name)


def test_help_is_a_page_or_two() -> None:
    """It names every public name, and first what a user needs first."""
    text = pydoc.plain(pydoc.render_doc(shmmap))
    assert text.count("\n") < 400
    described = text.partition("PACKAGE CONTENTS")[0]
    assert set(re.findall(r"`(?:shmmap\.)?(\w+)`", described)) >= set(dir(shmmap)) - {"__version__"}
    first = described.index("::")
    for name in ("connect", "Client", "Circle", "Box", "Cell", "MapWindow"):
        assert f"`{name}`" in described[:first]
