# SPDX-License-Identifier: Apache-2.0
"""A published map that is verified: until when it is signed, what is refused, whether the clock is right."""

from __future__ import annotations

import datetime
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from shmmap.doctor.finding import Finding, fail, ok, skip, warn
from shmmap.statistics.counters import REFUSALS

if TYPE_CHECKING:
    from shmmap.doctor.patient import Patient

__all__ = ["check_signature", "signature_lines", "trust_problems"]

_SKEW_S: Final = 300.0
"""Clocks of a publisher and of a vehicle may differ by so much, seconds."""
_REFUSED: Final = {
    "unsigned": "shmmap publish MAP URL --sign KEYDIR signs it",
    "older": "is something old served to this machine, or was the map restored from a backup?",
    "expired": "shmmap versions URL --refresh --sign KEYDIR signs it again; is the clock right?",
    "altered": "was it damaged on its way or by others? `shmmap reload` names what",
    "foreign_root": "is it the right URL, and the ROOT.json of the keys that sign it?",
    "other": "`shmmap reload` says why",
}


def trust_problems(counters: Mapping[str, int], now_s: float) -> list[str]:
    """What is wrong with the signature of the map that is served, and with what its origin offers.

    Parameters
    ----------
    now_s
        This machine's clock, Unix time.
    """
    found = []
    until_s, cause = _times(counters)[1], _refusal(counters)
    if until_s and until_s <= _latest(counters, now_s):
        found.append(f"what signs the map has expired since {_text_of(until_s)}: it is served on")
    if cause:
        named = cause.replace("_", " ")
        refused = counters.get("published_refused", 0)
        offer = f"version {refused}, which is offered," if refused else "what the map's origin offers"
        why = "cannot be taken" if cause == REFUSALS[-1] else f"is refused, {named}"
        found.append(f"{offer} {why}: what was taken is served")
    return found


def signature_lines(counters: Mapping[str, int], now_s: float) -> list[str]:
    """Until when the map is signed, and what is wrong with that; nothing of a map that is not signed."""
    until_s = _times(counters)[1]
    problems = trust_problems(counters, now_s)
    if not until_s or until_s <= _latest(counters, now_s):
        return problems
    return [f"verified, valid until {_text_of(until_s)}", *problems]


def check_signature(patient: Patient) -> Finding:
    """Is the map verified, and in time?"""
    name = "signature"
    if not patient.alive or patient.seen is None:
        return skip(name, "no daemon runs")
    counters, now_s = patient.seen.counters, time.time()
    signed_s, until_s = _times(counters)
    problems, cause = trust_problems(counters, now_s), _refusal(counters)
    if not until_s and not cause:
        return skip(name, "the map is not verified: the daemon runs without --trust")
    if now_s + _SKEW_S < signed_s:
        return fail(
            name,
            f"this machine's clock says {_text_of(now_s)}, earlier than {_text_of(signed_s)}, when the map"
            " was signed",
            "set the clock: without it nothing can be found to have expired",
        )
    if until_s and until_s <= _latest(counters, now_s):
        return fail(
            name,
            "; ".join(problems),
            "is the store in reach and the clock right? shmmap versions URL --refresh --sign KEYDIR, once a"
            " day, keeps it valid",
        )
    if cause:
        return warn(name, problems[0], _REFUSED[cause])
    return ok(name, signature_lines(counters, now_s)[0])


def _times(counters: Mapping[str, int]) -> tuple[float, float]:
    """When the map was signed, and until when that is valid; 0: it is not."""
    names = ("published_signed_unix_ns", "published_expires_unix_ns")
    signed_s, until_s = (counters.get(name, 0) * 1e-9 for name in names)
    return signed_s, until_s


def _latest(counters: Mapping[str, int], now_s: float) -> float:
    """The time it is at least: a clock may be behind."""
    return max(now_s, _times(counters)[0])


def _refusal(counters: Mapping[str, int]) -> str:
    at = counters.get("published_refusal", 0)
    return REFUSALS[at] if at < len(REFUSALS) else REFUSALS[-1]


def _text_of(unix_s: float) -> str:
    return f"{datetime.datetime.fromtimestamp(unix_s, datetime.timezone.utc):%Y-%m-%d %H:%M} UTC"
