# SPDX-License-Identifier: Apache-2.0
"""Whole daemons that serve a published map under a root of trust: what they take, refuse, and still serve."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

import shmmap
from shmmap.doctor.verdicts import trust_problems
from shmmap.errors import Offline, ShmmapError
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Verbs as Verbs
from tests.support.command_line import doctor, health, verb
from tests.support.compiled_programs import built_preload
from tests.support.daemon_process import DaemonProcess, Deadline, counters, stop
from tests.support.divided_map import make_map
from tests.support.published_daemon import (
    flip,
    until,
    until_asked,
    until_health,
    until_taken,
    versions_of,
    without,
)
from tests.support.web_servers import FaultyWeb, faulty_web

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")
pytest.importorskip("tuf", reason="tuf is not installed")

from tests.support.published_maps import Signed, in_days

DAY_S = 86400


@pytest.fixture
def web(signed_maps: Path, tmp_path: Path) -> Iterator[FaultyWeb]:
    """A web server of the map's version 1."""
    shutil.copytree(signed_maps / "one", tmp_path / "www")
    with faulty_web(tmp_path / "www") as one:
        yield one


@pytest.fixture
def keys(signed_maps: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(signed_maps / "keys", tmp_path / "keys"))


@pytest.fixture
def offer(signed_maps: Path, web: FaultyWeb) -> Callable[[str], None]:
    """Have the web server offer another state of the map, in one step."""

    def change(name: str) -> None:
        late = ("timestamp.json", "CURRENT")
        shutil.copytree(
            signed_maps / name, web.folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns(*late)
        )
        for path in late:
            shutil.copy(signed_maps / name / path, web.folder / f"{path}.new")
            (web.folder / f"{path}.new").rename(web.folder / path)

    return change


Offering = Callable[[str], None]


def sign_timestamp(web: FaultyWeb, keys: Path, **fields: object) -> Signed:
    """Sign the offered timestamp again, as the next one, with other fields."""
    signed = Signed(web.folder, keys)
    sign_timestamp_of(signed, **fields)
    return signed


def sign_timestamp_of(signed: Signed, **fields: object) -> None:
    signed.write("timestamp", **{"version": signed.timestamp.signed.version + 1, **fields})


def trusting(keys: Path) -> tuple[str, str]:
    return "--trust", str(keys / "ROOT.json")


def problems(one: DaemonProcess) -> str:
    """Problems with the signature and the offer, by the statistics."""
    return "; ".join(trust_problems(counters(one), time.time()))


# --- the first start ----------------------------------------------------------------------------------

REFUSED: dict[str, Callable[[FaultyWeb, Path, Offering], object]] = {
    "unsigned": lambda web, _keys, _offer: (web.folder / "timestamp.json").unlink(),
    "expired": lambda web, keys, _offer: sign_timestamp(web, keys, expires=in_days(-0.5)),
    "altered": lambda web, _keys, _offer: flip(web.folder / "timestamp.json"),
    "foreign root": lambda _web, _keys, offer: offer("other"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_first_start_refuses(
    name: str, daemon: DaemonFactory, web: FaultyWeb, keys: Path, offer: Offering
) -> None:
    REFUSED[name](web, keys, offer)
    one = daemon(web.url, *trusting(keys), start=False)
    assert one.run_to_end() == 65
    assert f"what is offered is refused, {name}: " in one.log
    assert web.url in one.log
    assert "\nhint: " in one.log
    assert not list(one.state_dir.rglob("*.taken"))


def test_a_first_start_refuses_what_is_older_or_altered_in_its_root(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path, offer: Offering
) -> None:
    offer("two")
    flip(web.folder / "blobs/sha256" / Signed(web.folder, keys).current["root"])
    one = daemon(web.url, *trusting(keys), start=False)
    assert one.run_to_end() == 65
    assert "its SHA-256 is not its name" in one.log
    assert not list(one.state_dir.rglob("*.taken"))
    offer("one")  # newer metadata was seen, although it was not taken
    assert one.run_to_end() == 65
    assert "refused, older" in one.log


def test_current_is_not_read(daemon: DaemonFactory, web: FaultyWeb, keys: Path, offer: Offering) -> None:
    offer("two")
    (web.folder / "CURRENT").unlink()
    web.requests()
    one = daemon(web.url, *trusting(keys), "--poll", "1")
    assert len(versions_of(one)) == 2
    asked = until_asked(web, "timestamp.json", 3)
    assert not [path for path, _ in asked if path in ("CURRENT", "versions/2.json")]
    assert "signature" in verb(one, "status")[1]
    assert health(one)[0] == 0
    # a directory without it, too
    two = daemon(web.folder, *trusting(keys))
    assert versions_of(two).keys() == versions_of(one).keys()


def test_what_cannot_be_verified(daemon: DaemonFactory, signed_maps: Path, keys: Path) -> None:
    """Files, an unsigned map, and a map under what is no root of trust."""
    for trust, says in (("/nowhere/ROOT.json", "No such file"), ("/proc/self/status", "no root of trust")):
        one = daemon(signed_maps / "one", "--trust", trust, start=False)
        assert one.run_to_end() == 78
        assert says in one.log
    one = daemon(signed_maps / "town/pointcloud_map.pcd/0_0.pcd", *trusting(keys), start=False)
    assert one.run_to_end() == 78
    assert "--trust is for a published map" in one.log
    one = daemon(signed_maps / "town", *trusting(keys), start=False)
    assert one.run_to_end() == 65
    assert "refused, unsigned" in one.log


def test_without_the_package_it_says_what_to_install(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path, tmp_path: Path
) -> None:
    one = daemon(web.url, *trusting(keys), start=False, environment=without("tuf", tmp_path))
    assert one.run_to_end() == 69
    assert "pip install tuf 'securesystemslib[crypto]'" in one.log


# --- while it is served -------------------------------------------------------------------------------


def test_a_new_version_is_taken_when_it_is_signed(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path, offer: Offering
) -> None:
    one = daemon(web.url, *trusting(keys), "--poll", "1")
    before = versions_of(one)
    asked = until_asked(web, "timestamp.json", 5)
    verified = [path for path, _ in asked if path == "2.root.json"]
    assert ("timestamp.json", 304) in asked, "polls are conditional"
    assert len(verified) <= 2, "and verify nothing that has not changed"
    offer("two")
    until(lambda: versions_of(one) != before)
    now = versions_of(one)
    assert [cell for cell in now if now[cell] != before[cell]] == ["/town/0_0.pcd"]
    until_health(one, 0)
    assert doctor(one)[1]["signature"]["state"] == "ok"
    assert "reload failed" not in one.log


def test_what_is_refused_later_is_said_once_and_what_was_taken_is_served(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path, offer: Offering, tmp_path: Path
) -> None:
    """Unsigned, expired, altered, foreign, older, another map under the same number: one after another."""
    offer("two")
    one = daemon(web.url, *trusting(keys), "--poll", "1")
    served = versions_of(one)
    changes: dict[str, Callable[[FaultyWeb, Path, Offering], object]] = {
        **REFUSED, "older": lambda _web, _keys, offer: offer("one"),
    }  # fmt: skip
    for number, (name, change) in enumerate(changes.items(), 1):
        change(web, keys, offer)
        until(lambda name: f"is refused, {name}" in problems(one), name)
        web.requests()
        until_asked(web, "timestamp.json", 4)  # by then it is logged: verifying asks twice itself
        logged = one.log.count("reload failed")  # also of what was seen while the store was being changed
        assert logged >= number
        until_asked(web, "timestamp.json", 3)
        assert one.log.count("reload failed") == logged
        assert versions_of(one) == served
        shutil.rmtree(web.folder)
        web.folder.mkdir()
        offer("two")
        sign_timestamp_of(Signed(web.folder, keys), version=10 * number)
        until(lambda: problems(one) == "" and not counters(one)["last_reload_failed"])
    offer("equal")
    sign_timestamp_of(Signed(web.folder, keys), version=100)
    until(lambda: "is refused, altered" in problems(one))
    assert "offers another map as version 2" in one.log
    assert versions_of(one) == served
    made = make_map(tmp_path / "town", columns=2, rows=1, points=100)
    assert Verbs(tmp_path).json("publish", made.root, web.folder, "--sign", keys)["version"] == 3
    until(lambda: versions_of(one) != served and problems(one) == "")


def test_a_refusal_is_seen_by_every_verb_also_after_a_restart(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path
) -> None:
    one = daemon(web.url, *trusting(keys), "--poll", "1")
    served, says = versions_of(one), "is refused, altered"
    until_taken(one)
    whole = (web.folder / "timestamp.json").read_bytes()
    flip(web.folder / "timestamp.json")
    for _ in range(2):
        until(lambda: says in problems(one))
        code, text = health(one)
        assert (code, says in text) == (1, True)
        assert "could not be read again" not in text, "it is said once"
        one.stop()
        one.start()
        assert versions_of(one) == served
    until(lambda: says in problems(one))
    assert verb(one, "health")[0] == 0, "clients lack nothing"
    assert says in verb(one, "status")[1]
    found = doctor(one)[1]
    assert says in found["versions"]["fact"]
    assert (found["versions"]["state"], found["versions"]["advice"] != "") == ("warn", True)
    assert found["signature"]["state"] == "ok"
    with shmmap.connect(one.endpoint) as client, pytest.raises(ShmmapError, match="refused, altered"):
        client.reload()
    (web.folder / "timestamp.json").write_bytes(whole)
    until_health(one, 0)


def test_an_altered_object_of_the_root_is_said_once_and_taken_once_it_is_whole(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path, offer: Offering, signed_maps: Path
) -> None:
    one = daemon(web.url, *trusting(keys), "--poll", "1")
    served = versions_of(one)
    root = Signed(signed_maps / "two", keys).current["root"]
    web.fault = lambda path: "corrupt" if path.endswith(root) else ""
    offer("two")
    until(lambda: health(one)[0] != 0)
    until_asked(web, "timestamp.json", 4)
    assert one.log.count("reload failed") == 1
    assert versions_of(one) == served
    web.heal()
    until_health(one, 0)
    assert versions_of(one) != served


def test_signed_again_it_is_valid_for_longer_also_after_a_restart(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path
) -> None:
    one = daemon(web.url, *trusting(keys), "--poll", "1")
    served = versions_of(one)
    expires = sign_timestamp(web, keys, expires=in_days(5)).timestamp.signed.expires.timestamp()
    until(lambda: counters(one)["published_expires_unix_ns"] == int(expires * 1e9))
    assert "reload done" not in one.log
    said = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(expires))
    assert f"verified, valid until {said}" in verb(one, "status")[1]
    one.stop()
    web.refuse()
    one.start()
    until(lambda: counters(one)["published_expires_unix_ns"] == int(expires * 1e9))
    assert versions_of(one) == served


# --- restarts -----------------------------------------------------------------------------------------


def test_a_start_without_a_link_serves_what_was_taken_under_that_root_alone(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path, signed_maps: Path
) -> None:
    one = daemon(web.url, *trusting(keys))
    served = versions_of(one)
    until_taken(one)
    one.stop()
    web.refuse()
    one.start()
    assert versions_of(one) == served
    one.stop()
    # no version taken under another root of trust, or without one
    one.arguments = list(trusting(signed_maps / "others"))
    assert one.run_to_end() == 71
    assert "no answer" in one.log
    web.listen()
    assert one.run_to_end() == 65
    assert "refused, foreign root" in one.log
    two = daemon(web.url)
    assert versions_of(two) == served
    until_taken(two)
    two.stop()
    web.refuse()
    two.arguments = list(trusting(keys))
    assert two.run_to_end() == 71
    web.listen()
    two.start()
    assert versions_of(two) == served
    assert len(list(two.state_dir.rglob("*.taken"))) >= 1


def test_another_root_of_trust_while_it_runs(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path, signed_maps: Path
) -> None:
    one = daemon(web.url, *trusting(keys))
    served = versions_of(one)
    shutil.copy(signed_maps / "others/ROOT.json", keys / "ROOT.json")
    with shmmap.connect(one.endpoint) as client, pytest.raises(ShmmapError, match="refused, foreign root"):
        client.reload()
    (keys / "ROOT.json").unlink()
    with shmmap.connect(one.endpoint) as client, pytest.raises(ShmmapError, match=r"ROOT\.json: No such"):
        client.reload()
    until(lambda: "cannot be taken" in health(one)[1])
    assert versions_of(one) == served


# --- the clock ----------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def _shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built_preload("clock", tmp_path_factory.mktemp("clock"))


@pytest.fixture
def clock(_shim: Path) -> Callable[[float], dict[str, str]]:
    """Environment of a process whose clock is ``days`` days ahead."""

    def off(days: float) -> dict[str, str]:
        return {"LD_PRELOAD": str(_shim), "CLOCK_AHEAD_S": str(int(days * DAY_S))}

    return off


Clock = Callable[[float], dict[str, str]]


def test_a_clock_a_day_ahead(daemon: DaemonFactory, web: FaultyWeb, keys: Path, clock: Clock) -> None:
    expires = sign_timestamp(web, keys, expires=in_days(1)).timestamp.signed.expires
    one = daemon(web.url, *trusting(keys), start=False, environment=clock(1.01))
    assert one.run_to_end() == 65
    assert f"refused, expired: timestamp.json was valid until {expires:%Y-%m-%d %H:%M} UTC" in one.log
    assert f"this machine's clock says {in_days(1.01):%Y-%m-%d}" in one.log
    assert "is the clock right?" in one.log
    for name in clock(0):
        del one.environment[name]
    one.start()  # the clock was set
    assert len(versions_of(one)) == 2


def test_what_was_taken_is_served_on_when_it_has_expired(
    daemon: DaemonFactory, web: FaultyWeb, keys: Path, clock: Clock
) -> None:
    """The link is up, and what it offers is refused; then it is down."""
    expires = sign_timestamp(web, keys, expires=in_days(1)).timestamp.signed.expires
    one = daemon(web.url, *trusting(keys), "--poll", "1")
    served = versions_of(one)
    until_taken(one)
    one.stop()
    one.environment.update(clock(1.01))
    since = f"expired since {expires:%Y-%m-%d %H:%M} UTC: it is served on"
    for is_down in (False, True):
        if is_down:
            web.refuse()
        one.start()
        assert versions_of(one) == served
        until(lambda: since in health(one, clock(1.01))[1])
        assert health(one, clock(1.01))[0] == 1
        assert since in verb(one, "status", env=clock(1.01))[1]
        if not is_down:
            until(lambda: "is refused, expired" in health(one, clock(1.01))[1])
        assert versions_of(one) == served
        code, text = verb(one, "doctor", "--json", env=clock(1.01))
        assert code == 1
        assert since in text
        one.stop()
    web.listen()
    for name in clock(0):
        del one.environment[name]
    one.start()
    until_health(one, 0)


def test_a_clock_a_day_behind(daemon: DaemonFactory, web: FaultyWeb, keys: Path, clock: Clock) -> None:
    """It is named; metadata that had expired when the timestamp was signed counts as expired."""
    sign_timestamp(web, keys, expires=in_days(1))
    one = daemon(web.url, *trusting(keys), "--poll", "1", environment=clock(-1))
    assert len(versions_of(one)) == 2
    until(lambda: counters(one)["published_signed_unix_ns"])
    text = verb(one, "doctor", "--json", env=clock(-1))[1]
    assert f"this machine's clock says {in_days(-1):%Y-%m-%d}" in text
    assert "when the map was signed" in text
    signed = Signed(web.folder, keys)
    signed.write_all(2, timestamp=signed.timestamp.signed.version + 1, expires=in_days(-0.5))
    until(lambda: "is refused, expired" in problems(one))
    assert f"targets.json was valid until {signed.targets.signed.expires:%Y-%m-%d %H:%M} UTC" in one.log
    assert "the timestamp was signed on" in one.log


# --- the process that verifies ------------------------------------------------------------------------


def verifiers(one: DaemonProcess) -> list[int]:
    """Processes of a daemon that verify."""
    found = []
    for pid in one.children():
        with suppress(OSError):
            if b"verify_version" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


def test_it_may_be_killed_or_hang(daemon: DaemonFactory, web: FaultyWeb, keys: Path, offer: Offering) -> None:
    one = daemon(web.url, *trusting(keys), "--poll", "0")
    served = versions_of(one)
    caught: list[int] = []

    def catch(number: signal.Signals) -> Callable[[str], str]:
        def fault(path: str) -> str:
            if path == "2.root.json" and not caught:
                caught.extend(verifiers(one))
                for pid in caught:
                    os.kill(pid, number)
                return "stall"
            return ""

        return fault

    offer("two")
    web.fault = catch(signal.SIGKILL)
    with shmmap.connect(one.endpoint) as client, pytest.raises(ShmmapError):
        client.reload()
    until(lambda: "cannot be taken" in problems(one))
    assert "ended with signal SIGKILL" in one.log
    assert len(caught) == 1
    assert versions_of(one) == served
    web.heal()
    caught.clear()
    web.fault = catch(signal.SIGSTOP)
    waiting = Deadline()
    while waiting(not caught):  # on a busy machine the time can be over before it asks for anything
        with shmmap.connect(one.endpoint) as client, pytest.raises(Offline, match="not read within 4 s"):
            client.reload()
    assert len(caught) == 1
    stop(caught[0])
    assert versions_of(one) == served
    os.kill(caught[0], signal.SIGKILL)
    web.heal()
    with shmmap.connect(one.endpoint) as client:
        waiting = Deadline()
        while waiting(versions_of(one) == served):
            with suppress(ShmmapError):  # the one before is not over, or the machine is slow
                client.reload()
    assert not verifiers(one)
    until_health(one, 0)


def test_a_daemon_ends_while_it_verifies(daemon: DaemonFactory, web: FaultyWeb, keys: Path) -> None:
    one = daemon(web.url, *trusting(keys), "--poll", "1")
    asked: list[str] = []

    def fault(path: str) -> str:
        asked.append(path)
        return "stall" if path == "2.root.json" else ""

    web.fault = fault
    sign_timestamp(web, keys)
    until(lambda: "2.root.json" in asked)
    assert one.stop() == 0
    web.heal()


def test_where_a_store_hides_what_it_does_not_have(daemon: DaemonFactory, web: FaultyWeb, keys: Path) -> None:
    """A bucket whose user may read but not list objects answers 403 for an absent one."""
    web.fault = lambda path: "" if (web.folder / path).exists() else "403"
    one = daemon(web.url, *trusting(keys))
    assert len(versions_of(one)) == 2
