# SPDX-License-Identifier: Apache-2.0
"""Findings, and verdicts from the counters alone, in the same words for ``status``, ``top`` and ``doctor``.

The verdicts: whether the cache is too small, how long the storage has been out of reach, whether the map's
signature is valid.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from shmmap.quantities import format_bytes, format_duration, format_utc
from shmmap.statistics.counters import REFUSALS

__all__ = [
    "Finding",
    "State",
    "Verdict",
    "cache_verdict",
    "fail",
    "ok",
    "outage_so_far",
    "refused_offer",
    "signature_expiry",
    "signature_lines",
    "signature_times",
    "skip",
    "trust_problems",
    "valid_until",
    "warn",
    "worst",
]

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
