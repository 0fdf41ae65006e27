# SPDX-License-Identifier: Apache-2.0
"""What PROTOCOL.md and LAYOUT.md say, tried by a client that was made of these pages and nothing else.

Each test has what it needs from the page's own words: bytes, numbers, examples.
"""

from __future__ import annotations

import os
import re
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xxhash

from shmmap.client.discovery import candidates
from shmmap.errors import BadRequest
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.message_pack import pack
from tests.support.plain_client import (
    PROTOCOL,
    PlainClient,
    Refused,
    Stale,
    documented_bytes,
    socket_paths,
)

Plain = Callable[..., PlainClient]
HERE = ["box", -5.0, -5.0, 5.0, 5.0]
FOUR = ["-20_-20.pcd", "-20_0.pcd", "0_-20.pcd", "0_0.pcd"]


def said(pattern: str) -> tuple[str, ...]:
    """Groups of the one place where the page says this; a line may end at any space."""
    found = re.findall(pattern.replace(" ", r"\s+"), PROTOCOL)
    assert len(found) == 1, (pattern, found)
    return found[0] if isinstance(found[0], tuple) else (found[0],)


@pytest.fixture
def plain(daemon: DaemonFactory) -> Iterator[Plain]:
    """Connect, ``plain(daemon, hello=..., ...)``; closed at the end of the test."""
    opened: list[PlainClient] = []

    def factory(to: DaemonProcess, *, hello: bool = True, **options: Any) -> PlainClient:
        opened.append(PlainClient(to.endpoint, **options))
        if hello:
            opened[-1].hello()
        return opened[-1]

    yield factory
    for one in opened:
        one.close()


@pytest.fixture
def one(standing: DaemonProcess, plain: Plain) -> PlainClient:
    """Return a client with a session of a daemon that other tests use, too."""
    return plain(standing)


def refusal(one: PlainClient, tag: str, *elements: Any) -> str:
    with pytest.raises(Refused) as refused:
        one.ask(tag, *elements)
    assert refused.value.request > 0
    return refused.value.code


# --- finding the daemon ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "environ",
    [
        {"SHMMAP_ENDPOINT": "/a/b.sock", "SHMMAP_INSTANCE": "town"},
        {"SHMMAP_ENDPOINT": "ipc:///a/b.sock"},
        {"SHMMAP_ENDPOINT": "b.sock"},
        {"SHMMAP_ENDPOINT": "", "SHMMAP_INSTANCE": "town", "SHMMAP_RUNTIME_DIR": "/a"},
        {"SHMMAP_RUNTIME_DIR": "/a", "XDG_RUNTIME_DIR": "/run/user/1"},
        {"SHMMAP_INSTANCE": "town", "XDG_RUNTIME_DIR": "/run/user/1"},
        {"SHMMAP_INSTANCE": "", "XDG_RUNTIME_DIR": ""},
        {},
    ],
)
def test_where_clients_look(environ: dict[str, str]) -> None:
    assert socket_paths(environ) == candidates(None, environ)


def test_a_path_too_long_for_a_socket() -> None:
    (most,) = said(r"One of more than (\d+) bytes is no socket address")
    assert candidates("/" + "x" * (int(most) - 1), {})
    with pytest.raises(BadRequest):
        candidates("/" + "x" * int(most), {})


def test_the_next_path_where_no_daemon_listens(standing: DaemonProcess, plain: Plain, tmp_path: Path) -> None:
    ended = tmp_path / "ended.sock"
    code = "import socket, sys; socket.socket(socket.AF_UNIX).bind(sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, str(ended)], check=True)
    one = PlainClient([str(tmp_path / "never.sock"), str(ended), standing.endpoint])
    assert one.hello()[0] == "welcome"
    one.close()


# --- the bytes of a connection --------------------------------------------------------------------


def test_the_bytes_of_the_page() -> None:
    """As a ZeroMQ library makes them, by rfc.zeromq.org/spec/23."""
    greeting = documented_bytes("greeting")
    assert greeting == b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
    for kind in ("DEALER", "SUB"):
        body = b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind.encode()
        assert documented_bytes(f"ready of a {kind}") == bytes((4, len(body))) + body
    assert documented_bytes("ping") == b"\x04\x07\x04PING\x00\x00"
    assert documented_bytes("pong") == b"\x04\x05\x04PONG"


def test_everything_can_be_sent_at_once(standing: DaemonProcess, plain: Plain) -> None:
    """Greeting, ready and requests, without waiting for anything; also byte by byte."""
    one = plain(standing, hello=False)  # it has sent greeting and ready, and has not waited for a ready
    numbers = [one.send("hello", 3, 0), one.send("metadata"), one.send("stats")]
    assert [one.reply_to(n)[0] for n in numbers] == ["welcome", "metadata_page", "stats_reply"]
    (ready,) = one.commands
    assert ready.startswith(b"\x05READY")
    assert b"\x0bSocket-Type\x00\x00\x00\x06ROUTER" in ready
    frame = pack(["metadata", 99])
    for byte in bytes((0, len(frame))) + frame:
        one.connection.sendall(bytes((byte,)))
    assert one.reply_to(99)[0] == "metadata_page"
    one.connection.sendall(b"\x02" + struct.pack(">Q", len(frame)) + frame)
    assert one.reply_to(99)[0] == "metadata_page", "a short one may have a long length"


def test_long_requests_and_replies(one: PlainClient) -> None:
    held = [[f"/nowhere/{number}.pcd", number] for number in range(300)]
    assert one.ask("differential", HERE, ["points"], held)[5] == [cell for cell, _ in held]


def test_ping(one: PlainClient) -> None:
    one.connection.sendall(documented_bytes("ping"))
    context = bytes(range(16))
    one.send_frame(b"\x04PING\x00\x0a" + context, 4)
    one.ask("metadata")
    pong = documented_bytes("pong")[2:]
    assert one.commands[1:] == [pong, pong + context]


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(documented_bytes("ready of a SUB"), id="another type of socket"),
        pytest.param(b"\x00\x01\x90", id="a message before the ready"),
        pytest.param(b"\x04\x06\x05READY", id="a ready without a type"),
    ],
)
def test_a_peer_that_breaks_the_rules_is_disconnected(standing: DaemonProcess, wrong: bytes) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        one.settimeout(30.0)
        one.connect(standing.endpoint)
        one.sendall(documented_bytes("greeting") + wrong)
        with one.makefile("rb") as listener:
            assert listener.read()[:64] == documented_bytes("greeting")


def test_a_command_that_is_not_known_is_ignored(one: PlainClient) -> None:
    one.send_frame(b"\x05LATER\x01\x02\x03", 4)
    assert one.ask("metadata")[0] == "metadata_page"


def test_several_frames_are_refused(one: PlainClient) -> None:
    one.send_frame(b"", 1)
    one.send_frame(pack(["metadata", 7]))
    with pytest.raises(Refused) as refused:
        one.reply_to(0)
    assert refused.value.code == "bad_request"


def test_events(served: DaemonProcess, plain: Plain) -> None:
    one = plain(served)
    listener = PlainClient(one.events, ready="ready of a SUB")
    listener.connection.sendall(documented_bytes("subscribe to all"))
    kind, number, epoch, _ = listener.message()
    assert (kind, epoch) == ("beat", one.epoch)
    page = one.ask("recent", 0, 0, 0)
    assert (page[3], page[4], page[5]) == (1, number + 1, []), "limit 0: only first and next"
    joined = plain(served)
    while (event := listener.message())[0] == "beat":  # one a second
        assert event[1] == number
    assert (event[0], event[1], event[4]) == ("joined", number + 1, joined.session)
    (most,) = said(r"never more than (\d+)\.")
    for _ in range(int(most) // 2):
        guest = PlainClient(served.endpoint)
        guest.hello()
        guest.send("bye")
        guest.close()
    while one.ask("recent", 0, 0, 0)[4] <= int(most) + 1:
        one.ask("stats")
    assert len(one.ask("recent", 0, 0, 10_000)[5]) == int(most)
    listener.close()


# --- minor versions -------------------------------------------------------------------------------


@pytest.mark.parametrize("minor", [0, 99])
def test_every_minor_version_is_answered(standing: DaemonProcess, plain: Plain, minor: int) -> None:
    one = plain(standing, hello=False)
    assert one.hello(minor=minor)[2:4] == [3, 0]
    cells = one.ask("area", HERE, ["points"], 30.0)
    assert [handle[0] for handle in cells[4]] == FOUR
    assert cells[5:9] == [[], b"", [], []]
    assert (len(cells), cells[12]) == (13, "")


def test_what_the_daemon_does_not_know(one: PlainClient) -> None:
    assert refusal(one, "of_a_later_version", 1, 2) == "bad_request"
    assert one.ask("area", HERE, ["points"], 30.0, None, "", "new", {"a": 1})[0] == "cells"
    assert refusal(one, "hello", 4, 0) == "protocol_mismatch"
    one.send_frame(b"\xc1")
    with pytest.raises(Refused) as refused:
        one.reply_to(0)
    assert refused.value.code == "bad_request"


# --- what is asked for ----------------------------------------------------------------------------


def test_half_a_z_range(one: PlainClient) -> None:
    for half in ([1.0], [1.0, None], [None, 1.0]):
        for area in (["circle", 0, 0, 5, *half], ["square", 0, 0, 5, *half], ["box", 0, 0, 5, 5, *half]):
            for request in ("area", "differential", "metadata"):
                assert refusal(one, request, area) == "bad_request"
    for z in ([], [None], [None, None], [-100.0, 100.0]):
        assert one.ask("metadata", ["circle", 0, 0, 5, *z])[4]


def test_wait_has_limits(one: PlainClient) -> None:
    low, high = map(float, said(r"f64 seconds, (\d+) … (\d+), that the reply may wait"))
    for wait in (low, high, int(high), None):
        assert one.ask("area", ["circle", 1e6, 0, 1], ["points"], wait)[0] == "cells"
    for wait in (low - 0.001, high + 0.001, float("nan"), float("inf")):
        assert refusal(one, "area", HERE, ["points"], wait) == "bad_request"


def test_layers_in_canonical_form(one: PlainClient) -> None:
    *others, canonical = said(
        r"`(ndt.*?)`, `(ndt.*?)` and `(ndt.*?)` are one layer, the last is its canonical form"
    )
    asked = ["points", *others, canonical]
    reply = one.ask("area", HERE, asked, 30.0)
    assert reply[9] == ["points", canonical, canonical, canonical]
    handles = [(handle[0], handle[2]) for handle in reply[4]]
    assert handles == [(name, layer) for name in FOUR for layer in ("points", canonical)]
    reply = one.ask("selected", ["0_0.pcd", FOUR[0], "0_0.pcd"], [canonical, "points", "points"], 30.0)
    assert reply[9:] == [[canonical, "points", "points"], True, "", ""]
    assert [handle[0] for handle in reply[4]] == [
        name for name in ("0_0.pcd", FOUR[0], "0_0.pcd") for _ in "ab"
    ]
    assert [handle[2] for handle in reply[4]] == [canonical, "points"] * 3
    held = [handle[1] for handle in reply[4]]
    reply = one.ask("differential", HERE, asked, [], struct.pack("<6Q", *held), 30.0)
    assert (reply[9], reply[10]) == (["points", canonical, canonical, canonical], True)
    assert {handle[0] for handle in reply[4]} == set(FOUR) - {"0_0.pcd", FOUR[0]}
    assert one.ask("differential", HERE, ["voxel( 1 )"])[9] == ["voxel(leaf=1.0)"], "cold: pending"


def test_how_many_layers(one: PlainClient) -> None:
    (most,) = said(r"an array of layer specs, at least one and at most (\d+);")
    assert one.ask("area", HERE, ["points"] * int(most))[9] == ["points"] * int(most)
    assert refusal(one, "area", HERE, ["points"] * (int(most) + 1)) == "bad_request"
    assert refusal(one, "area", HERE, []) == "bad_request"
    characters, chain = map(
        int, said(r"a spec has at most (\d+) characters, a chain of `of` at most (\d+) layers")
    )
    longest = "voxel(" + "1".rjust(characters - 7) + ")"
    assert one.ask("area", HERE, [longest])[9] == ["voxel(leaf=1.0)"]
    assert refusal(one, "area", HERE, [longest.replace("1", " 1")]) == "bad_request"

    def chained(layers: int) -> str:
        return "voxel(1)" if layers == 1 else f"voxel(1,of={chained(layers - 1)})"

    assert one.ask("area", HERE, [chained(chain)])[9] == [chained(chain).replace("(1", "(leaf=1.0")]
    assert refusal(one, "area", HERE, [chained(chain + 1)]) == "bad_request"


def test_removed_repeats_ids_as_the_client_wrote_them(one: PlainClient, standing_map: DividedMap) -> None:
    far = standing_map.id("40_40.pcd")
    held = [[far], ["40_40.pcd"], ["no such cell"], [standing_map.id("0_0.pcd")], [far]]
    assert one.ask("differential", HERE, ["points"], held)[5] == [far, "40_40.pcd", "no such cell"]
    failed = one.ask("selected", ["no such cell", "/nor/this"])[8]
    assert [(cell[0], cell[2]) for cell in failed] == [
        (i, "unknown_cell") for i in ("no such cell", "/nor/this")
    ]


def test_limits_of_metadata(one: PlainClient) -> None:
    first = one.ask("metadata", None, None, 0, 1)
    assert len(first[4]) == 1
    for start, limit in ((-5, 0), (0, -1), (-1, 1)):
        assert one.ask("metadata", None, None, start, limit)[4] == first[4]


# --- sessions -------------------------------------------------------------------------------------


def test_a_name_is_cut(served: DaemonProcess, plain: Plain) -> None:
    one = plain(served, hello=False)
    (most,) = said(r"\(cut at (\d+) characters;")
    one.hello(name="ü" * 100)
    assert [row[4] for row in one.ask("stats")[5]] == ["ü" * int(most)]


def test_every_connection_needs_a_hello(standing: DaemonProcess, plain: Plain, one: PlainClient) -> None:
    other = plain(standing, hello=False)
    assert refusal(other, "metadata") == "no_session"
    session = one.session
    assert one.hello()[7] == session, "a second hello on one connection"
    one.close()
    again = plain(standing, hello=False)
    assert refusal(again, "metadata") == "no_session"
    again.hello(session=session)
    assert again.session == session
    assert again.ask("metadata")[0] == "metadata_page"


def test_a_session_is_taken_over(served: DaemonProcess, plain: Plain) -> None:
    """By the same process: with all that it holds, and what waits for an answer on the old connection."""
    old = plain(served)
    handle = old.ask("selected", ["0_0.pcd"], ["points"], 30.0)[4][0]
    _, mapping = old.attach(handle)
    stopped = served.stop_loaders()
    waits = old.send("selected", ["20_20.pcd"], ["points"], 30.0)
    old.ask("metadata")  # what came before it has been read
    new = plain(served, hello=False)
    new.hello(session=old.session)
    assert new.session == old.session
    for pid in stopped:
        os.kill(pid, 18)
    assert new.reply_to(waits)[4][0][0] == "20_20.pcd", "answered here"
    assert refusal(old, "metadata") == "no_session"
    (row,) = new.ask("stats")[5]
    assert (row[0], row[6]) == (new.session, 2), "it holds what it was handed on both"
    old.close()
    (row,) = new.ask("stats")[5]
    assert row[0] == new.session, "the end of the old connection does not end it"
    mapping.close()


def test_a_session_is_a_wish(standing: DaemonProcess, plain: Plain, one: PlainClient) -> None:
    (power,) = said(r"\(another session's; 2\^(\d+) and more\)")
    for wish, granted in (
        (12345, True),
        (2 ** int(power) - 1, True),
        (2 ** int(power), False),
        (2**64 - 1, False),
    ):
        other = plain(standing, hello=False)
        other.hello(session=wish)
        assert (other.session == wish) is granted
        assert 0 < other.session < 2 ** int(power)
    code = (
        "import sys; from tests.support.plain_client import PlainClient\n"
        "one = PlainClient(sys.argv[1]); one.hello(session=int(sys.argv[2])); print(one.session)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, standing.endpoint, str(one.session)],
        capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert int(done.stdout) != one.session, "another process's is not taken over"
    assert one.ask("metadata")[0] == "metadata_page"


def test_a_session_goes_on_after_a_restart(
    served: DaemonProcess, plain: Plain, divided_map: DividedMap
) -> None:
    one = plain(served)
    handles = one.ask("area", HERE, ["points"], 30.0)[4]
    segment, mapping = one.attach(handles[0])
    before = segment.columns["xyz"].tobytes()
    served.kill()
    divided_map.change("-20_0.pcd", 3)
    served.start()
    with pytest.raises(ConnectionError):
        one.message()
    again = plain(served, hello=False)
    assert refusal(again, "metadata") == "no_session"
    again.hello(session=one.session)
    assert (again.session, again.epoch == one.epoch) == (one.session, False)
    assert mapping[:8] == b"SHMMAP\0\x01"
    held = [[handle[0], handle[1]] for handle in handles]
    reply = again.ask("differential", HERE, ["points"], held, b"", 30.0)
    assert ([handle[0] for handle in reply[4]], reply[5]) == (["-20_0.pcd"], [])
    same = again.ask("selected", [handles[0][0]], ["points"], 30.0)[4][0]
    assert same[1:3] == handles[0][1:3], "version and layer name the bytes, also across restarts"
    assert again.attach(same)[0].columns["xyz"].tobytes() == before
    (row,) = again.ask("stats")[5]
    assert row[0] == one.session
    mapping.close()


def test_bye_arrives_before_the_connection_ends(standing: DaemonProcess, plain: Plain) -> None:
    one, watcher = plain(standing), plain(standing)
    session = one.session
    one.send("bye")
    one.close()
    assert session not in [row[0] for row in watcher.ask("stats")[5]]


def test_release_is_of_every_layer_that_carried_the_version(served: DaemonProcess, plain: Plain) -> None:
    one = plain(served)
    handles = one.ask("selected", ["0_0.pcd"], ["points", "voxel(1)"], 30.0)[4]
    ((cells,),) = [[row[6]] for row in one.ask("stats")[5]]
    assert cells
    one.ask("release", struct.pack("<2Q", *(handle[1] for handle in handles)))
    ((cells, nbytes),) = [(row[6], row[7]) for row in one.ask("stats")[5]]
    assert (cells, nbytes) == (0, 0)


# --- handles and segments -------------------------------------------------------------------------


def test_what_a_handle_says(one: PlainClient, standing_map: DividedMap) -> None:
    handles = one.ask("area", HERE, ["points", "voxel(1)"], 30.0)[4]
    assert len(handles) == 8
    for handle in handles:
        cell, version, layer, _, _, nbytes, rows = handle[:7]
        segment, mapping = one.attach(handle)
        assert segment.fields["cell_id"] == one.id_prefix + cell == standing_map.id(cell)
        assert (segment.fields["layer"], segment.fields["rows"]) == (layer, rows)
        assert (segment.epoch, segment.version) == (one.epoch, version)
        assert nbytes % 4096 == 0
        assert segment.fields["total_bytes"] <= nbytes
        assert len(segment.columns["xyz"]) == rows
        for name, column in segment.columns.items():
            assert xxhash.xxh3_64_intdigest(np.ascontiguousarray(column).data) == segment.checksums[name]
        if layer == "points":
            source = standing_map.points(cell)
            assert rows == len(source["x"])
            assert segment.columns["xyz"][:, 0].tobytes() == source["x"].tobytes()
        mapping.close()


def test_the_daemon_knows_who_maps(served: DaemonProcess, plain: Plain) -> None:
    """By the lock on the session's byte; without it the segment stays just as well, its user is unknown."""
    one = plain(served)
    handle = one.ask("selected", ["0_0.pcd"], ["points"], 30.0)[4][0]
    _, mapping = one.attach(handle)
    one.ask("release")
    path = one.shm_dir + one.segment_prefix + handle[3]
    (row,) = one.ask("stats")[5]
    assert row[13] == os.stat(path).st_size
    mapping.close()
    with open(path, "rb") as without:
        stats = one.ask("stats")
        assert (stats[5][0][13], stats[6]) == (0, 1)
        assert one.ask("evict", ["0_0.pcd"])[2:4] == [0, 1], "it is mapped"
        assert without.read(8) == b"SHMMAP\0\x01"
        with pytest.raises(Stale):
            one.attach(handle)


FORKING = """
import os, sys
from tests.support.plain_client import PlainClient

one = PlainClient(sys.argv[1])
one.hello()
_, mapping = one.attach(one.ask("selected", ["0_0.pcd"], ["points"], 60.0)[4][0])
read, write = os.pipe()
if os.fork() == 0:
    os.close(write)
    os.read(read, 1)
    os._exit(mapping[:6] != b"SHMMAP")
mapping.close()
before = one.ask("stats")[5][0][13]
os.close(write)
_, status = os.wait()
print(status, before > 0, one.ask("stats")[5][0][13])
"""


def test_after_a_fork_both_hold_it_until_both_release_it(served: DaemonProcess) -> None:
    """Under the parent's session, as the kernel reports it."""
    done = subprocess.run(
        [sys.executable, "-c", FORKING, served.endpoint],
        capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.stdout.split() == ["0", "True", "0"]
