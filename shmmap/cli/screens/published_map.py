# SPDX-License-Identifier: Apache-2.0
"""What ``status``, ``top`` and ``map`` say of a published map; nothing where the map is files."""

from __future__ import annotations

import time
from collections.abc import Mapping

from shmmap.doctor.signed_map import signature_lines, trust_problems
from shmmap.quantities import counted, format_bytes, format_duration, format_utc
from shmmap.statistics.counters import OBJECTS_READ

__all__ = ["published_as_json", "published_lines", "published_words", "since"]


def published_as_json(counters: Mapping[str, int]) -> dict[str, object] | None:
    """Return what is known of a published map, for programs; None where the map is files."""
    if not counters.get("published_version"):
        return None
    times = {
        "taken_unix_s": "published_taken_unix_ns",
        "expires_unix_s": "published_expires_unix_ns",
        "offline_since_unix_s": "origin_out_since_unix_ns",
    }
    return {
        "version": counters["published_version"],
        "refused": counters["published_refused"] or None,
        **{name: counters[of] * 1e-9 if counters[of] else None for name, of in times.items()},
        "cells": counters["map_cells"],
        "cells_known": counters["map_cells_known"],
        "pages": counters["map_pages"],
        "pages_known": counters["map_pages_known"],
        **{name: counters[name] for name in OBJECTS_READ},
    }


def published_lines(counters: Mapping[str, int]) -> list[tuple[str, str]]:
    """Return label and text of each line; none where the map is files."""
    if not counters.get("published_version"):
        return []
    lines = [("version", _version(counters)), ("known", _known(counters)), ("fetched", _fetched(counters))]
    lines[1:1] = [("signature", text) for text in _signature(counters)]
    if troubles := _troubles(counters):
        lines.append(("", troubles))
    return lines


def published_words(counters: Mapping[str, int]) -> list[tuple[str, bool]]:
    """Return the same as short texts, each with whether it is a problem."""
    if not counters.get("published_version"):
        return []
    problems = trust_problems(counters, time.time())
    pieces = [(f"version {_version(counters)}", False)]
    pieces += [(text, text in problems) for text in _signature(counters)]
    pieces += [(_known(counters), False), (_fetched(counters), False), (_troubles(counters), True)]
    return [(text, trouble) for text, trouble in pieces if text]


def since(counters: Mapping[str, int]) -> str:
    """Return `` (since TIME)`` while the origin is out of reach, else an empty string."""
    began_ns = counters.get("origin_out_since_unix_ns", 0)
    return f" (since {format_utc(began_ns // 10**9, seconds=True)})" if began_ns else ""


def _version(counters: Mapping[str, int]) -> str:
    taken_ns = counters["published_taken_unix_ns"]
    ago = format_duration(max(time.time() - taken_ns * 1e-9, 0.0))
    return f"{counters['published_version']}, taken on {format_utc(taken_ns // 10**9)}, {ago} ago"


def _signature(counters: Mapping[str, int]) -> list[str]:
    return signature_lines(counters, time.time())


def _known(counters: Mapping[str, int]) -> str:
    cells, known = counters["map_cells"], counters["map_cells_known"]
    pages = (
        f"{counters['map_pages_known']:,} of {counted(counters['map_pages'], 'page')} of the list of cells"
    )
    return (
        f"all {counted(cells, 'cell')}"
        if known >= cells
        else f"{known:,} of {counted(cells, 'cell')}, {pages}"
    )


def _fetched(counters: Mapping[str, int]) -> str:
    fetched = f"{counted(counters['objects_fetched'], 'object')}, {format_bytes(counters['bytes_fetched'])}"
    disk = f"{counted(counters['objects_from_disk'], 'object')}, {format_bytes(counters['bytes_from_disk'])}"
    return f"{fetched}; from the disk {disk}"


def _troubles(counters: Mapping[str, int]) -> str:
    found = (
        ("fetches_failed", "fetches failed"),
        ("objects_damaged_on_disk", "objects were damaged on the disk"),
        ("objects_damaged_in_store", "came damaged from the store"),
    )
    return ", ".join(f"{counters[name]:,} {text}" for name, text in found if counters[name])
