# SPDX-License-Identifier: Apache-2.0
"""``shmmap`` and ``shmmap.client``: every public name is there, and only those."""

from __future__ import annotations

import inspect

import pytest

import shmmap
import shmmap.client
from shmmap import errors


@pytest.mark.parametrize("package", [shmmap, shmmap.client], ids=lambda package: package.__name__)
def test_every_name_of_all_is_there(package: object) -> None:
    names: list[str] = package.__all__  # type: ignore[attr-defined]
    assert sorted(names) == sorted(set(names))
    for name in names:
        assert getattr(package, name) is not None


@pytest.mark.parametrize("package", [shmmap, shmmap.client], ids=lambda package: package.__name__)
def test_another_name_is_an_attribute_error(package: object) -> None:
    with pytest.raises(AttributeError, match="no attribute 'conect'"):
        package.conect  # type: ignore[attr-defined]  # noqa: B018


def test_all_errors_are_public() -> None:
    tree = {
        name for name, kind in vars(errors).items() if inspect.isclass(kind) and issubclass(kind, Exception)
    }
    assert tree <= set(shmmap.__all__)
    assert {name for name in tree if getattr(shmmap, name) is getattr(errors, name)} == tree


def test_client_names_are_public() -> None:
    assert set(shmmap.client.__all__) <= set(shmmap.__all__)
    for name in shmmap.client.__all__:
        assert getattr(shmmap, name) is getattr(shmmap.client, name)


def test_dir_lists_what_is_not_loaded_yet() -> None:
    assert set(shmmap.__all__) <= set(dir(shmmap))
