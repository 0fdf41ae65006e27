# SPDX-License-Identifier: Apache-2.0
"""Probe the store of a published map as the daemon does, in a separate process with a time limit.

Requests go to the configured URL only, with the daemon's credentials if this account may see their source. A
credentials file that blocks, or a server that sends a byte a second, can delay only that process.  It is then
killed, and its last report is used.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from email.utils import parsedate_to_datetime
from typing import Any, Final

import msgspec

from shmmap.errors import ConfigError, MapDataError, MapMissing, Offline, PackageMissing, ShmmapError

ASKED_S: Final = 12.0
"""Seconds that the process may take, including its start."""
_CLOCK_S: Final = 3.0
_NAMED: Final = ("AWS_", "GOOGLE_", "AZURE_")
_OTHERS: Final = (
    "SERVICE_ACCOUNT",
    "CREDENTIALS_DIRECTORY",
    "SSL_CERT_FILE",
    "SSL_CERT_DIR",
    "HOME",
    "HTTP_PROXY",
    "HTTPS_PROXY",
    "ALL_PROXY",
    "NO_PROXY",
    "http_proxy",
    "https_proxy",
    "all_proxy",
    "no_proxy",
)


class StoreQuestion(msgspec.Struct):
    """A store to probe, and the number of the version that is served (0: none)."""

    url: str
    insecure_http: bool = False
    instance_credentials: bool = False
    served: int = 0


class StoreAnswer(msgspec.Struct):
    """Reply of the store; durations in seconds, points in time as Unix time."""

    credentials: str = ""
    """Source of the credentials, never their values."""
    credentials_error: str = ""
    credentials_hint: str = ""
    is_refused: bool = False
    """Whether the store refuses the credentials."""
    answers: bool = False
    """Whether the store answers at all, even with a refusal."""
    first_s: float | None = None
    """Seconds for one small object over a new connection; ``next_s``: for the next object."""
    next_s: float | None = None
    error: str = ""
    hint: str = ""
    version: int = 0
    """Number of the newest published version; 0: unknown."""
    created_s: float | None = None
    """Publication time of the newest version; ``served_created_s``: of the served one."""
    served_created_s: float | None = None
    clock_s: float | None = None
    """Seconds by which the store's clock is ahead of this machine's."""


def ask_store(question: StoreQuestion, environment: Mapping[str, str] | None) -> StoreAnswer:
    """Probe the store.

    Parameters
    ----------
    environment
        Environment of the daemon, of which only variables for the credentials or the connection are used;
        None if unreadable, which uses the environment of this process.
    """
    given = dict(os.environ)
    if environment is not None:
        given = {name: value for name, value in given.items() if not _is_of_a_store(name)}
        given |= {name: value for name, value in environment.items() if _is_of_a_store(name)}
    given["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "shmmap.doctor.store_probe", msgspec.json.encode(question).decode()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=given,
            cwd="/",
        )
    except OSError as error:
        return StoreAnswer(error=f"it cannot be asked: {sys.executable}: {error.strerror}")
    is_late = False
    try:
        said, _ = process.communicate(timeout=ASKED_S)
    except subprocess.TimeoutExpired:
        is_late = True
        process.kill()
        said, _ = process.communicate()
    lines = said.splitlines()
    answer = msgspec.json.decode(lines[-1], type=StoreAnswer) if lines else StoreAnswer()
    if not is_late and process.returncode and not answer.error:
        answer.error = f"the process that asks it ended with {process.returncode}"
    return answer


def _is_of_a_store(name: str) -> bool:
    return name.startswith(_NAMED) or name in _OTHERS


# --- in the separate process --------------------------------------------------------------------------


def main(words: str) -> None:
    """Probe, and print all results so far after each step; the last line counts."""
    question, answer = msgspec.json.decode(words, type=StoreQuestion), StoreAnswer()
    for step in (_ask_credentials, _ask_objects, _ask_clock):
        step(question, answer)
        sys.stdout.write(msgspec.json.encode(answer).decode() + "\n")
        sys.stdout.flush()
    os._exit(0)  # do not wait for threads that are still probing


def _ask_credentials(question: StoreQuestion, answer: StoreAnswer) -> None:
    from shmmap.origin.remote.credentials import credentials_source
    from shmmap.origin.remote.store import read_url

    try:
        scheme = read_url(question.url).scheme
        answer.credentials = credentials_source(scheme, os.environ, instance=question.instance_credentials)
    except ConfigError as error:
        answer.credentials_error, answer.credentials_hint = str(error), error.hint
    except ShmmapError as error:
        answer.error, answer.hint = error.message, error.hint


def _ask_objects(question: StoreQuestion, answer: StoreAnswer) -> None:
    from shmmap.origin.remote.map_versions import read_current, read_entry
    from shmmap.origin.remote.opened_store import ServedFrom, open_for_serving
    from shmmap.origin.remote.store import StoreRefused, Timeouts

    if answer.error or answer.credentials_error:
        return
    timeouts = Timeouts(connect_s=3.0, read_s=3.0, retries=0, retry_s=3.0)
    served = ServedFrom(question.url, question.insecure_http, question.instance_credentials)
    try:
        store = open_for_serving(served, timeouts)
        began_s = time.monotonic()
        current = read_current(store).current
        answer.first_s, answer.answers = time.monotonic() - began_s, True
        if current is None:
            answer.error, answer.hint = "no map is published there", "shmmap publish MAP URL publishes one"
            return
        answer.version = current.version
        began_s = time.monotonic()
        with contextlib.suppress(MapMissing):
            answer.created_s = read_entry(store, current.version).created_s
            answer.next_s = time.monotonic() - began_s
        if question.served == current.version:
            answer.served_created_s = answer.created_s
        elif question.served:
            with contextlib.suppress(MapMissing):
                answer.served_created_s = read_entry(store, question.served).created_s
    except StoreRefused as error:
        answer.answers, answer.is_refused = True, error.of_credentials
        answer.error, answer.hint = error.message, error.hint
    except Offline as error:
        answer.error, answer.hint = error.message, error.hint
    except PackageMissing as error:
        answer.error, answer.hint = f"it cannot be asked with this Python: {error.message}", error.hint
    except ShmmapError as error:
        answer.answers = answer.answers or isinstance(error, MapDataError)
        answer.error, answer.hint = str(error), error.hint


def _ask_clock(question: StoreQuestion, answer: StoreAnswer) -> None:
    """Compare clocks by the ``Date`` header of any reply, requested without credentials."""
    import urllib.error
    import urllib.request

    from shmmap.origin.remote.bucket_store import server_url
    from shmmap.origin.remote.store import read_url

    if not answer.answers:
        return
    url = server_url(read_url(question.url))
    if not url:
        return

    class Stay(urllib.request.HTTPRedirectHandler):
        """Refuses redirects."""

        def redirect_request(self, *_: Any, **__: Any) -> None:
            return None

    request = urllib.request.Request(url, method="HEAD", headers={"User-Agent": "shmmap"})  # noqa: S310  http
    with contextlib.suppress(OSError, ValueError):
        try:
            with urllib.request.build_opener(Stay).open(request, timeout=_CLOCK_S) as reply:
                headers = reply.headers
        except urllib.error.HTTPError as refused:
            headers = refused.headers
            refused.close()
        here_s = time.time()
        there_s = parsedate_to_datetime(headers["Date"]).timestamp() + float(headers.get("Age", "0"))
        answer.clock_s = there_s - here_s


if __name__ == "__main__":
    main(sys.argv[1])
