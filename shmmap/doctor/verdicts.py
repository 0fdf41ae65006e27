# SPDX-License-Identifier: Apache-2.0
"""Findings, and verdicts from the statistics, in the same words for all screens.

The verdicts: what is wrong, worst first; whether the cache is too small, how long the storage has been out of
reach, whether the map's signature is valid.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from shmmap.installed import RESTART
from shmmap.quantities import counted, format_bytes, format_duration, format_utc
from shmmap.statistics.counters import REFUSALS

if TYPE_CHECKING:
    from shmmap.statistics.reader import Snapshot

State = Literal["ok", "warn", "fail"]
_SEVERITY: Final[dict[State, int]] = {"ok": 0, "warn": 1, "fail": 2}


@dataclass(frozen=True, slots=True)
class Finding:
    """One result of a check: subject, fact, and advice."""

    name: str
    """Subject; `shmmap.doctor.checks.diagnose` fills it in."""
    state: State
    """``ok``; ``warn`` for what may cause trouble later; ``fail`` for what causes trouble now."""
    fact: str
    advice: str = ""
    """Advice; empty if nothing needs to be done."""
    skipped: bool = False
    """Whether the check does not apply or was not possible, which is no problem; ``state`` is then ``ok``."""


def skip(fact: str) -> Finding:
    """Return a finding that the check does not apply."""
    return Finding("", "ok", fact, skipped=True)


def ok(fact: str, advice: str = "") -> Finding:
    """Return a finding without a problem; ``advice`` may still suggest an improvement."""
    return Finding("", "ok", fact, advice)


def warn(fact: str, advice: str) -> Finding:
    """Return a finding that may cause trouble later."""
    return Finding("", "warn", fact, advice)


def fail(fact: str, advice: str) -> Finding:
    """Return a finding that hinders the daemon or a client now."""
    return Finding("", "fail", fact, advice)


def worst(findings: list[Finding]) -> State:
    """Return the most severe state among findings."""
    return max((one.state for one in findings), key=_SEVERITY.__getitem__, default="ok")


def problems(found: Snapshot) -> list[Finding]:
    """Return what is wrong with a daemon, worst first; empty if nothing is."""
    counters, state = found.counters, state_problem(found)
    known = [*([] if state is None else [state]), *troubles(found)]
    if count := counters.get("unloadable", 0):
        known.append(
            fail(f"{counted(count, 'layer')} of cells cannot be loaded", "`shmmap doctor` names them")
        )
    cache = cache_verdict(counters)
    if cache.too_small and not counters.get("refused_over_budget_1min", 0):
        known.append(warn(f"the cache is TOO SMALL: {cache.why}", cache.hint))
    if count := counters.get("defects", 0):
        known.append(warn(f"it survived {counted(count, 'exception')}", "please report what its log says"))
    return sorted(known, key=lambda one: -_SEVERITY[one.state])


def state_problem(found: Snapshot) -> Finding | None:
    """Return what keeps a daemon from answering, by its state; None if it is healthy, or does not run."""
    pid = found.identity.pid if found.identity is not None else 0
    silent = f"no heartbeat for {format_duration(found.beat_age_s)}"
    return {
        "starting": warn("starting: it does not listen yet", "wait: kernels are compiled the first time"),
        "stopped": fail(f"PAUSED, {silent}", f"continue it: kill -CONT {pid}"),
        "hung": fail(
            f"HUNG, {silent}",
            "if its log says that it cannot write its statistics, lift that limit; else the watchdog ends it"
            f" under systemd, elsewhere kill -ABRT {pid}",
        ),
        "dead": fail("DEAD: it crashed or was killed", "start it again: it keeps the cells in memory"),
    }.get(found.state)


def troubles(found: Snapshot) -> list[Finding]:
    """Return problems that clients have although the daemon replies."""
    counters, live = found.counters, found.live
    known = []
    if count := counters.get("refused_over_budget_1min", 0):
        known.append(
            fail(
                f"{counted(count, 'cell')} refused for lack of memory in the last minute",
                "raise --budget; `shmmap clients` lists the users of memory",
            )
        )
    if counters.get("origin_out", 0):
        known.append(fail("no load succeeds: the map's files are out of reach", "`shmmap doctor`"))
    known += [
        fail(f"live map {row.name}: {row.problem}", "`shmmap live ls` shows whether it goes on")
        for row in live
        if row.problem
    ]
    if counters.get("last_reload_failed", 0) and not counters.get("published_refusal", 0):
        known.append(
            fail("the map could not be read again: its old state is served", "`shmmap reload` says why")
        )
    known += [warn(problem, "`shmmap doctor` says more") for problem in trust_problems(counters, time.time())]
    known += [
        warn(
            f"live map {row.name}: {row.damaged_count:,} lost chunks or damaged databases"
            + (f": {'; '.join(row.damaged[:_NAMED])}" if row.damaged else ""),
            "`shmmap doctor` says what to do",
        )
        for row in live
        if row.damaged_count
    ]
    if count := counters.get("map_problems", 0):
        known.append(
            warn(
                f"{counted(count, 'problem')} in the map", "`shmmap reload` names them, and the daemon's log"
            )
        )
    if counters.get("package_replaced", 0):
        known.append(warn(RESTART, "it keeps what is in memory"))
    return known


_NAMED: Final = 3
"""Damaged files that are named, at most."""

RELOADED_SHARE: Final = 0.05
RELOADED_COUNT: Final = 10
"""With fewer loads than this, no share proves anything."""


class Verdict(NamedTuple):
    """A judgement of the budget: whether it is too small, why, and what to do."""

    too_small: bool
    why: str
    hint: str = ""

    @property
    def text(self) -> str:
        """The verdict and its reason."""
        return f"{'TOO SMALL' if self.too_small else 'large enough'}: {self.why}"


def cache_verdict(counters: Mapping[str, int]) -> Verdict:
    """Judge the budget by the last ten minutes: cells refused, and cells loaded again after eviction.

    Cells refused because of a client's quota do not count.
    """
    refused = counters.get("refused_over_budget_10min", 0)
    evicted = counters.get("evictions_10min", 0)
    again = counters.get("loads_after_eviction_10min", 0)
    misses = max(counters.get("misses_10min", 0), again)
    budget, in_use = counters.get("budget_bytes", 0), counters.get("bytes_pinned", 0)
    if refused:
        return Verdict(
            True,
            f"{refused:,} cells refused in the last 10 min; clients use {format_bytes(in_use)} of"
            f" {format_bytes(budget)}",
            "raise --budget; `shmmap clients` lists the users of memory",
        )
    if again >= RELOADED_COUNT and again > RELOADED_SHARE * misses:
        share = 100 * again / misses
        return Verdict(
            True,
            f"{again:,} loads in the last 10 min ({share:.0f} % of all) were of cells evicted before",
            "raise --budget",
        )
    if evicted:
        return Verdict(False, f"{evicted:,} evicted for room in the last 10 min, hardly any asked for again")
    past = [
        f"{count:,} {what}"
        for count, what in (
            (counters.get("evictions", 0), "evicted for room"),
            (counters.get("refused_over_budget", 0), "refused"),
        )
        if count
    ]
    if past:
        before = " and ".join(past)
        return Verdict(
            False, f"nothing evicted for room or refused in the last 10 min ({before} since the start)"
        )
    return Verdict(False, "nothing evicted for room, nothing refused")


def outage_so_far(counters: Mapping[str, int]) -> str:
    """Return how long the map's storage has been out of reach: ``"less than a second"``, ``"5.0 s"``."""
    outage_s = counters.get("last_outage_ns", 0) * 1e-9
    return "less than a second" if outage_s < 1.0 else format_duration(outage_s)


_ADVICE: Final = {
    "unsigned": "shmmap publish MAP URL --sign KEYDIR signs it",
    "older": "is something old served to this machine, or was the map restored from a backup?"
    " if it is meant, serve it once with --accept-version",
    "expired": "shmmap versions URL --refresh --sign KEYDIR signs it again; is the clock right?",
    "altered": "was it damaged on its way or by others? `shmmap reload` names what",
    "foreign_root": "is it the right URL, and the ROOT.json of the keys that sign it?",
    "other": "`shmmap reload` says why",
}


def trust_problems(counters: Mapping[str, int], now_s: float) -> list[str]:
    """Return problems with the signature of the served map, and with the newest published version.

    Parameters
    ----------
    now_s
        This machine's clock, Unix time.
    """
    expired, (refused, _) = signature_expiry(counters, now_s), refused_offer(counters)
    return [problem for problem in (expired, refused) if problem]


def refused_offer(counters: Mapping[str, int]) -> tuple[str, str]:
    """Return why the version that the origin offers is refused, and what to do; empty if it is accepted."""
    at = counters.get("published_refusal", 0)
    cause = REFUSALS[at] if at < len(REFUSALS) else REFUSALS[-1]
    if not cause:
        return "", ""
    number = counters.get("published_refused", 0)
    offer = f"version {number}, which is offered," if number else "what the map's origin offers"
    why = "cannot be taken" if cause == REFUSALS[-1] else f"is refused, {cause.replace('_', ' ')}"
    return f"{offer} {why}: what was taken is served", _ADVICE[cause]


def signature_lines(counters: Mapping[str, int], now_s: float) -> list[str]:
    """Return lines on how long the signature is valid, and its problems; empty for a map without either."""
    until_s = signature_times(counters)[1]
    problems = trust_problems(counters, now_s)
    if not until_s or signature_expiry(counters, now_s):
        return problems
    return [valid_until(until_s), *problems]


def signature_times(counters: Mapping[str, int]) -> tuple[float, float]:
    """Return when the map was signed, and until when that is valid, as Unix time; 0: not signed."""
    names = ("published_signed_unix_ns", "published_expires_unix_ns")
    signed_s, until_s = (counters.get(name, 0) * 1e-9 for name in names)
    return signed_s, until_s


def signature_expiry(counters: Mapping[str, int], now_s: float) -> str:
    """Return when the signature expired, by the later of clock and signing time; empty if it is valid."""
    signed_s, until_s = signature_times(counters)
    if not until_s or until_s > max(now_s, signed_s):
        return ""
    return f"what signs the map has expired since {format_utc(until_s)}: it is served on"


def valid_until(until_s: float) -> str:
    """Return a text on how long a verified signature is valid."""
    return f"verified, valid until {format_utc(until_s)}"
