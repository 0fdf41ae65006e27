# SPDX-License-Identifier: Apache-2.0
"""A published map: link, credentials, clock and versions, as this account sees them beside the daemon."""

from __future__ import annotations

import datetime
import time
from collections.abc import Mapping
from typing import Final

from shmmap.daemon.prerequisites import account_name
from shmmap.doctor.finding import Finding, fail, ok, skip, warn
from shmmap.doctor.patient import Patient
from shmmap.doctor.signed_map import refused_offer
from shmmap.doctor.store_probe import ASKED_S
from shmmap.doctor.verdicts import outage_so_far
from shmmap.origin.remote.store import is_published, is_url
from shmmap.quantities import format_duration

__all__ = ["check_clock", "check_credentials", "check_link", "check_versions"]

MOST_OFF_S: Final = 60.0
"""The link cannot explain a minute; a difference of 5 or 15 makes stores refuse signed requests."""
FILES: Final = "the map is files"


def _is_published(patient: Patient) -> bool:
    path = patient.map_path
    return bool(path) and is_published(path if is_url(path) else str(patient.machine.path(path)))


def _counters(patient: Patient) -> Mapping[str, int]:
    return patient.seen.counters if patient.alive and patient.seen is not None else {}


def check_link(patient: Patient) -> Finding:
    """Does the store answer, and how soon?"""
    name = "link"
    if not _is_published(patient):
        return skip(name, FILES)
    answer, path, counters = patient.store, patient.map_path, _counters(patient)
    away = (
        f"the daemon has not reached it for {outage_so_far(counters)}" if counters.get("origin_out") else ""
    )
    if answer.first_s is not None:
        times = f"{format_duration(answer.first_s)} for a small object over a new connection"
        if answer.next_s is not None:
            times += f", {format_duration(answer.next_s)} for the next one"
        fact = f"{path} answers: {times}"
        if answer.error:
            return warn(name, f"{fact}; {answer.error}", answer.hint or "is it the right URL?")
        if away:
            return warn(name, f"{fact}; {away}", "it tries again each second; if that stays so, see its log")
        return ok(name, fact)
    if answer.is_refused and patient.environment is None and patient.alive and not away:
        return ok(name, f"{path} answers; it refuses what this account has for credentials")
    if answer.credentials_error:
        return skip(name, f"{path} was not asked: see credentials")
    error = answer.error or f"no answer within {ASKED_S:.0f} s"
    fact = error if error.startswith(path) else f"{path}: {error}"
    if patient.alive:
        fact += f"; {away or 'the daemon reached it when it last asked'}"
    return warn(name, fact, answer.hint or "is the network up?")


def check_credentials(patient: Patient) -> Finding:
    """Where do credentials come from, and does the store take them?"""
    name = "credentials"
    if not _is_published(patient):
        return skip(name, FILES)
    answer, hidden = patient.store, _hidden(patient)
    if answer.credentials_error:
        hint = answer.credentials_hint or "`shmmap publish --help` says where they may come from"
        return (warn if hidden else fail)(name, f"{answer.credentials_error}{hidden}", hint)
    if not answer.credentials:
        return skip(name, "a directory needs none, and a web server is asked without any")
    fact = f"from {answer.credentials}{hidden}"
    if answer.is_refused:
        return warn(name, f"{fact}; {answer.error}", answer.hint)
    if answer.first_s is None:
        return ok(name, f"{fact}; the store was not reached")
    return ok(name, f"{fact}; the store takes them")


def _hidden(patient: Patient) -> str:
    """Return a note if the daemon's own credentials cannot be seen, else an empty text."""
    if not patient.alive or patient.environment is not None:
        return ""
    account = account_name(patient.runs_as)
    return f" (this account's: those of the daemon, of {account}, can be seen with sudo)"


def check_clock(patient: Patient) -> Finding:
    """Does this machine's clock agree with the store's?"""
    name = "clock"
    if not _is_published(patient):
        return skip(name, FILES)
    off_s = patient.store.clock_s
    if off_s is None:
        answers = patient.store.answers
        return skip(name, f"the store {'does not say what time it is' if answers else 'was not reached'}")
    if abs(off_s) <= MOST_OFF_S:
        return ok(name, f"within {max(abs(off_s), 1.0):.0f} s of the store's")
    side = "behind" if off_s > 0 else "ahead of"
    return warn(
        name,
        f"{format_duration(abs(off_s))} {side} the store's: what is signed is refused on both sides",
        "set the clock: timedatectl set-ntp true, or what the vehicle has for time",
    )


def check_versions(patient: Patient) -> Finding:
    """Is what is served what is offered, and how old is it?"""
    name = "versions"
    if not _is_published(patient):
        return skip(name, FILES)
    answer, counters = patient.store, _counters(patient)
    served, offered = counters.get("published_version", 0), answer.version
    offer = "what is offered is not known"
    if offered:
        offer = f"version {offered}{_published(answer.created_s)} is offered"
    if not served:
        return ok(name, offer) if offered else skip(name, f"{offer}; no daemon says what it serves")
    taken_s = counters["published_taken_unix_ns"] * 1e-9
    fact = f"version {served}{_published(answer.served_created_s)} is served, taken {_ago(taken_s)}"
    refused, advice = refused_offer(counters)
    if refused:
        return warn(name, f"{fact}; {refused}", advice)
    if not offered or offered == served:
        return ok(name, f"{fact}; {offer}" if not offered else f"{fact}; it is what is offered")
    if offered < served:
        return warn(
            name,
            f"{fact}; {offer}, which is older",
            f"if it is meant: shmmap serve --accept-version {offered}; else publish again",
        )
    return ok(name, f"{fact}; {offer}", "it is taken at the next --poll; `shmmap reload` takes it now")


def _published(created_s: float | None) -> str:
    if created_s is None:
        return ""
    return f" of {datetime.datetime.fromtimestamp(created_s, datetime.timezone.utc):%Y-%m-%d}"


def _ago(moment_s: float) -> str:
    return f"{format_duration(max(time.time() - moment_s, 0.0))} ago"
