# SPDX-License-Identifier: Apache-2.0
"""Check a published map: link, credentials, clock, versions and signature, as seen by this account."""

from __future__ import annotations

import datetime
import time
from typing import Final

from shmmap.daemon.prerequisites import account_name
from shmmap.doctor.diagnosis import Diagnosis
from shmmap.doctor.store_probe import ASKED_S
from shmmap.doctor.verdicts import (
    Finding,
    fail,
    ok,
    outage_so_far,
    refused_offer,
    signature_expiry,
    signature_times,
    skip,
    valid_until,
    warn,
)
from shmmap.quantities import format_duration, format_utc

MAX_OFF_S: Final = 60.0
"""Clock difference that the link's delay cannot explain; at 5 or 15 minutes stores refuse signed requests."""
_SKEW_S: Final = 300.0
"""Seconds allowed between the clocks of a publisher and of a vehicle."""


def check_link(diagnosis: Diagnosis) -> Finding:
    """Check that the store answers, and how fast."""
    answer, path, counters = diagnosis.store, diagnosis.map_path, diagnosis.counters
    away = (
        f"the daemon has not reached it for {outage_so_far(counters)}" if counters.get("origin_out") else ""
    )
    if answer.first_s is not None:
        times = f"{format_duration(answer.first_s)} for a small object over a new connection"
        if answer.next_s is not None:
            times += f", {format_duration(answer.next_s)} for the next one"
        fact = f"{path} answers: {times}"
        if answer.error:
            return warn(f"{fact}; {answer.error}", answer.hint or "is it the right URL?")
        if away:
            return warn(f"{fact}; {away}", "it tries again each second; if that stays so, see its log")
        return ok(fact)
    if answer.is_refused and diagnosis.environment is None and diagnosis.alive and not away:
        return ok(f"{path} answers; it refuses what this account has for credentials")
    if answer.credentials_error:
        return skip(f"{path} was not asked: see credentials")
    error = answer.error or f"no answer within {ASKED_S:.0f} s"
    fact = error if error.startswith(path) else f"{path}: {error}"
    if diagnosis.alive:
        fact += f"; {away or 'the daemon reached it when it last asked'}"
    return warn(fact, answer.hint or "is the network up?")


def check_credentials(diagnosis: Diagnosis) -> Finding:
    """Check the source of the credentials, and that the store accepts them."""
    answer, hidden = diagnosis.store, _hidden(diagnosis)
    if answer.credentials_error:
        hint = answer.credentials_hint or "`shmmap publish --help` says where they may come from"
        return (warn if hidden else fail)(f"{answer.credentials_error}{hidden}", hint)
    if not answer.credentials:
        return skip("a directory needs none, and a web server is asked without any")
    fact = f"from {answer.credentials}{hidden}"
    if answer.is_refused:
        return warn(f"{fact}; {answer.error}", answer.hint)
    if answer.first_s is None:
        return ok(f"{fact}; the store was not reached")
    return ok(f"{fact}; the store takes them")


def _hidden(diagnosis: Diagnosis) -> str:
    """Return a note if the daemon's own credentials are not visible to this account, else an empty text."""
    if not diagnosis.alive or diagnosis.environment is not None:
        return ""
    account = account_name(diagnosis.runs_as)
    return f" (this account's: those of the daemon, of {account}, can be seen with sudo)"


def check_clock(diagnosis: Diagnosis) -> Finding:
    """Check that this machine's clock agrees with the store's clock."""
    off_s = diagnosis.store.clock_s
    if off_s is None:
        answers = diagnosis.store.answers
        return skip(f"the store {'does not say what time it is' if answers else 'was not reached'}")
    if abs(off_s) <= MAX_OFF_S:
        return ok(f"within {max(abs(off_s), 1.0):.0f} s of the store's")
    side = "behind" if off_s > 0 else "ahead of"
    return warn(
        f"{format_duration(abs(off_s))} {side} the store's: what is signed is refused on both sides",
        "set the clock: timedatectl set-ntp true, or what the vehicle has for time",
    )


def check_versions(diagnosis: Diagnosis) -> Finding:
    """Check that the newest published version is served, and how old it is."""
    answer, counters = diagnosis.store, diagnosis.counters
    served, offered = counters.get("published_version", 0), answer.version
    offer = "what is offered is not known"
    if offered:
        offer = f"version {offered}{_published(answer.created_s)} is offered"
    if not served:
        return ok(offer) if offered else skip(f"{offer}; no daemon says what it serves")
    taken_s = counters["published_taken_unix_ns"] * 1e-9
    ago = format_duration(max(time.time() - taken_s, 0.0))
    fact = f"version {served}{_published(answer.served_created_s)} is served, taken {ago} ago"
    refused, advice = refused_offer(counters)
    if refused:
        return warn(f"{fact}; {refused}", advice)
    if not offered or offered == served:
        return ok(f"{fact}; {offer}" if not offered else f"{fact}; it is what is offered")
    if offered < served:
        return warn(
            f"{fact}; {offer}, which is older",
            f"if it is meant: shmmap serve --accept-version {offered}; else publish again",
        )
    return ok(f"{fact}; {offer}", "it is taken at the next --poll; `shmmap reload` takes it now")


def check_signature(diagnosis: Diagnosis) -> Finding:
    """Check that the map's signature is verified, and has not expired."""
    counters, now_s = diagnosis.counters, time.time()
    signed_s, until_s = signature_times(counters)
    if not until_s:
        return skip("the map is not verified: the daemon runs without --trust")
    if now_s + _SKEW_S < signed_s:
        return fail(
            f"this machine's clock says {format_utc(now_s)}, earlier than {format_utc(signed_s)},"
            " when the map was signed",
            "set the clock: without it nothing can be found to have expired",
        )
    if expired := signature_expiry(counters, now_s):
        return fail(
            expired,
            "is the store in reach and the clock right? shmmap versions URL --refresh --sign KEYDIR, once a"
            " day, keeps it valid",
        )
    return ok(valid_until(until_s))


def _published(created_s: float | None) -> str:
    if created_s is None:
        return ""
    return f" of {datetime.datetime.fromtimestamp(created_s, datetime.timezone.utc):%Y-%m-%d}"
