# SPDX-License-Identifier: Apache-2.0
"""A published map that is verified: until when it is signed, what is refused, whether the clock is right."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from shmmap.doctor.finding import Finding, fail, ok, skip
from shmmap.quantities import format_utc
from shmmap.statistics.counters import REFUSALS

if TYPE_CHECKING:
    from shmmap.doctor.patient import Patient

__all__ = ["check_signature", "refused_offer", "signature_lines", "trust_problems"]

_SKEW_S: Final = 300.0
"""Difference allowed between the clocks of a publisher and of a vehicle, seconds."""
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
    """List what is wrong with the signature of the map that is served, and with the version offered.

    Parameters
    ----------
    now_s
        This machine's clock, Unix time.
    """
    expired, (refused, _) = _expiry(counters, now_s), refused_offer(counters)
    return [problem for problem in (expired, refused) if problem]


def refused_offer(counters: Mapping[str, int]) -> tuple[str, str]:
    """Say why the version that the map's origin offers is not taken, and what to do; empty if it is taken."""
    at = counters.get("published_refusal", 0)
    cause = REFUSALS[at] if at < len(REFUSALS) else REFUSALS[-1]
    if not cause:
        return "", ""
    number = counters.get("published_refused", 0)
    offer = f"version {number}, which is offered," if number else "what the map's origin offers"
    why = "cannot be taken" if cause == REFUSALS[-1] else f"is refused, {cause.replace('_', ' ')}"
    return f"{offer} {why}: what was taken is served", _ADVICE[cause]


def signature_lines(counters: Mapping[str, int], now_s: float) -> list[str]:
    """Until when the map is signed, and the problems with that; empty for a map without either."""
    until_s = _times(counters)[1]
    problems = trust_problems(counters, now_s)
    if not until_s or _expiry(counters, now_s):
        return problems
    return [_valid(until_s), *problems]


def check_signature(patient: Patient) -> Finding:
    """Check that the map is verified, and its signature not expired."""
    name = "signature"
    if not patient.alive or patient.seen is None:
        return skip(name, "no daemon runs")
    counters, now_s = patient.seen.counters, time.time()
    signed_s, until_s = _times(counters)
    if not until_s:
        return skip(name, "the map is not verified: the daemon runs without --trust")
    if now_s + _SKEW_S < signed_s:
        return fail(
            name,
            f"this machine's clock says {format_utc(now_s)}, earlier than {format_utc(signed_s)},"
            " when the map was signed",
            "set the clock: without it nothing can be found to have expired",
        )
    if expired := _expiry(counters, now_s):
        return fail(
            name,
            expired,
            "is the store in reach and the clock right? shmmap versions URL --refresh --sign KEYDIR, once a"
            " day, keeps it valid",
        )
    return ok(name, _valid(until_s))


def _times(counters: Mapping[str, int]) -> tuple[float, float]:
    """When the map was signed, and until when that is valid, Unix time; 0: it is not signed."""
    names = ("published_signed_unix_ns", "published_expires_unix_ns")
    signed_s, until_s = (counters.get(name, 0) * 1e-9 for name in names)
    return signed_s, until_s


def _expiry(counters: Mapping[str, int], now_s: float) -> str:
    """Say when the signature expired; empty if it has not.  The clock may be behind the signing time."""
    signed_s, until_s = _times(counters)
    if not until_s or until_s > max(now_s, signed_s):
        return ""
    return f"what signs the map has expired since {format_utc(until_s)}: it is served on"


def _valid(until_s: float) -> str:
    return f"verified, valid until {format_utc(until_s)}"
