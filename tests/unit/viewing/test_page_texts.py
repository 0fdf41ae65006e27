# SPDX-License-Identifier: Apache-2.0
"""Texts beside a browser's map show paths and messages as they are."""

from __future__ import annotations

import html

import pytest

from shmmap.viewing.browser.page import _plain


@pytest.mark.parametrize(
    "text", ["/maps/a_*b*_c", "<img src=x onerror=y>", "![x](http://y/z)", "`a`\n# b", "地図"]
)
def test_nothing_is_read_as_markup(text: str) -> None:
    shown = _plain(text)
    assert html.unescape(shown) == text
    assert not set(shown) & set("<>[]()*_`!\n\\{}|~")


def test_words_stay() -> None:
    assert _plain("the daemon is gone; waiting for it") == "the daemon is gone; waiting for it"
