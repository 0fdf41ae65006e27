# SPDX-License-Identifier: Apache-2.0
"""The statistics in Prometheus' text format, version 0.0.4.

Format of a line: https://prometheus.io/docs/instrumenting/exposition_formats/
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from shmmap.statistics.counters import PUBLISHED, SPANS, STEPS, WINDOWED, Histogram, lower_bound_ns
from shmmap.statistics.reader import Snapshot

if TYPE_CHECKING:
    from shmmap.protocol.rows import LiveMapRow

_LIVE = {
    # attribute of a row: name, kind, help
    "states": ("chunks", "gauge", "Chunks by state"),
    "bytes": ("bytes", "gauge", "Memory of chunks in service"),
    "waiting_bytes": ("waiting_bytes", "gauge", "Scans that wait for chunks or for memory"),
    "budget_bytes": ("budget_bytes", "gauge", "Most memory of the map's chunks"),
    "active": ("known_voxels", "gauge", "Voxels known of the chunks in memory"),
    "files": ("files", "gauge", "Chunks on disk"),
    "file_bytes": ("file_bytes", "gauge", "Chunks on disk: bytes of their files"),
    "scans": ("scans_applied_total", "counter", "Scans applied"),
    "durable": ("scans_durable_total", "counter", "Scans applied that are on disk"),
    "damaged_count": ("damaged_files", "gauge", "Lost chunks, and damaged databases"),
    "failing": ("failing", "gauge", "1 while chunks cannot be loaded or saved"),
}

_NO_TIME_IF_0 = {"origin_out_since_unix_ns", "published_expires_unix_ns", "published_signed_unix_ns"}
"""Times that are left out if they are 0: the year 1970 would raise alarms."""

_SHOWN_ELSEWHERE = {f"{name}_{span}" for name in WINDOWED for span in SPANS}  # Prometheus has rate()


def exposition(found: Snapshot, instance: str) -> str:
    """Return the text of a scrape; without a daemon it contains only that the daemon is not up.

    Parameters
    ----------
    found
        Statistics, with the live maps that the daemon lists.
    instance
        Label ``daemon`` of every sample (``instance`` is Prometheus' own label).
    """
    return "\n".join(_lines(found, instance)) + "\n"


def _lines(found: Snapshot, instance: str) -> Iterator[str]:
    label = f'daemon="{_escaped(instance)}"'

    def one(name: str, kind: str, text: str, value: float, more: str = "") -> Iterable[str]:
        name = f"shmmap_{name}"
        return (
            f"# HELP {name} {_escaped_help(text)}",
            f"# TYPE {name} {kind}",
            f"{name}{{{label}{more}}} {_number(value)}",
        )

    yield from one("up", "gauge", "1 if the daemon is healthy", found.state == "healthy")
    identity = found.identity
    if identity is None:
        return
    yield from one("beat_age_seconds", "gauge", "Time since the daemon last wrote", found.beat_age_s)
    started = identity.started_unix_ns * 1e-9
    yield from one("start_time_seconds", "gauge", "When this run of the daemon began, Unix time", started)
    more = "".join(
        f',{name}="{_escaped(value)}"'
        for name, value in (
            ("version", identity.library_version),
            ("map", identity.map_path),
            ("map_version", f"{identity.map_version:016x}"),
            ("epoch", f"{identity.epoch:016x}"),
            ("state", found.state),
        )
    )
    yield from one("info", "gauge", "What this daemon is and serves", 1, more)
    for counter in found.descriptions:
        value: float = found.counters[counter.name]
        name = counter.name
        if name in _SHOWN_ELSEWHERE or (name in PUBLISHED and not found.counters.get("published_version")):
            continue
        if name in _NO_TIME_IF_0 and not value:
            continue
        name = _conventional(name)
        if counter.unit == "ns":
            name = name.replace("_unix_ns", "_timestamp_ns").removesuffix("_ns") + "_seconds"
            value *= 1e-9
        if counter.kind == "counter":
            name += "_total"
        yield from one(name, counter.kind, counter.help, value)
    yield from _live_maps(found.live, label)
    for described in found.histogram_descriptions:
        name = f"shmmap_{described.name}_seconds"
        yield f"# HELP {name} {_escaped_help(described.help)}"
        yield f"# TYPE {name} histogram"
        yield from _histogram(name, label, found.histograms[described.name])


def _conventional(name: str) -> str:
    """Return a counter's name as Prometheus' conventions have it: the unit last."""
    name = name.replace("zombies", "retired_segments").replace("zombie", "retired")
    return f"{name.removeprefix('bytes_')}_bytes" if name.startswith("bytes_") else name


def _live_maps(rows: Sequence[LiveMapRow], label: str) -> Iterator[str]:
    """Yield each metric family once, with a sample for each map."""
    labels = [f'{label},map="{_escaped(row.name)}"' for row in rows]
    for field, (name, kind, text) in _LIVE.items() if rows else ():
        yield f"# HELP shmmap_live_{name} {_escaped_help(text)}"
        yield f"# TYPE shmmap_live_{name} {kind}"
        for row, mine in zip(rows, labels, strict=True):
            if field == "states":
                for state, count in row.states.items():
                    yield f'shmmap_live_{name}{{{mine},state="{state}"}} {count}'
            else:
                yield f"shmmap_live_{name}{{{mine}}} {int(getattr(row, field))}"


def _histogram(name: str, label: str, histogram: Histogram) -> Iterator[str]:
    """Yield a histogram with one bucket per octave, a quarter of the segment's: enough for a chart."""
    below = 0
    counts = histogram.counts
    for bucket, count in enumerate(counts[:-1]):
        below += count
        if bucket % STEPS == 0:
            yield f'{name}_bucket{{{label},le="{lower_bound_ns(bucket + 1) * 1e-9:.9g}"}} {below}'
    total = below + counts[-1]
    yield f'{name}_bucket{{{label},le="+Inf"}} {total}'
    yield f"{name}_sum{{{label}}} {_number(histogram.sum_ns * 1e-9)}"
    yield f"{name}_count{{{label}}} {total}"


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() and abs(value) < 1 << 62 else f"{value:.9f}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _escaped_help(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n")
