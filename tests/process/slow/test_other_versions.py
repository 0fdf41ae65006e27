# SPDX-License-Identifier: Apache-2.0
"""Client and daemon of different major versions: each names both versions, and what to update."""

from __future__ import annotations

import contextlib
import os
import struct
import threading
from pathlib import Path
from typing import Any

import pytest
import zmq

from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap, Verbs
from tests.support.divided_map import DividedMap
from tests.support.message_pack import pack, unpack
from tests.support.plain_client import PlainClient

HELLO = bytes.fromhex("95 a568656c6c6f 07")
"""What a hello begins with, as request 7; major, minor and the client's name follow."""
VERBS = (("query", "--circle", "0,0,5"), ("status",), ("ls",))
"""Verbs that ask the daemon, and verbs that read its statistics, where it can be found only by its socket."""
TIMEOUT_S = 60.0


@pytest.mark.parametrize(("major", "minor"), [(1, 5), (2, 0), (2, 2)])
def test_an_older_client_is_refused_and_stays_connected(
    daemon: DaemonFactory, divided_map: DividedMap, major: int, minor: int
) -> None:
    client = PlainClient(daemon(divided_map.root).endpoint)
    client.send_frame(HELLO + bytes((major, minor)) + b"\xa3old")
    said = f"client speaks protocol {major}.{minor}, daemon 3.0"
    hint = "update the client, and restart it; until then it keeps the cells that it has mapped"
    assert client.message() == ["error", 7, "protocol_mismatch", said, hint]
    assert client.hello()[0] == "welcome"
    client.close()


def test_a_daemon_of_1_x_is_named(shmmap: Verbs, short_path: Path) -> None:
    """It answers a hello of 3.0 as 1.5 did: an error whose elements have not changed since."""
    path, said = short_path / "old.sock", "client speaks protocol 3.0, daemon 1.5"
    asked: list[Any] = []

    def refuse() -> None:
        with (
            context.socket(zmq.ROUTER) as router,
            context.socket(zmq.XPUB) as events,
            contextlib.suppress(zmq.ContextTerminated),
        ):
            router.linger = events.linger = 0
            router.bind(f"ipc://{path}")
            events.bind(f"ipc://{path.with_suffix('.events.sock')}")
            listens.set()
            while True:
                client, message = router.recv_multipart()
                hello = unpack(message)
                asked.append((hello[0], hello[2:4]))
                refusal = ["error", hello[1], "protocol_mismatch", said, "update the older of the two"]
                router.send_multipart([client, pack(refusal)])

    context, listens = zmq.Context(), threading.Event()
    daemon = threading.Thread(target=refuse)
    daemon.start()
    try:
        assert listens.wait(TIMEOUT_S)
        printed = [shmmap(*words, "--endpoint", str(path), code=76) for words in VERBS]
        stop = shmmap("stop", "--endpoint", str(path), code=76)
    finally:
        context.term()
        daemon.join()
    assert {(tag, *version) for tag, version in asked} == {("hello", 3, 0)}
    assert said in stop
    assert f"a signal ends a daemon of any version: kill {os.getpid()}" in stop
    for text in printed:
        assert said in text
        assert "update the older of the two" in text


def test_statistics_of_an_older_daemon_are_named(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    """A reader does not take what 1.x left for its own; a daemon that starts replaces it."""
    one = daemon(divided_map.root, start=False)
    shmmap = Shmmap(one, tmp_path)
    header = struct.pack("<8sHHI12I", b"SHMSTAT\x01", 1, 5, 0x01020304, 128, 0, 160, *[4096] * 9)
    path = Path(one.shm_dir, f"shmmap.{one.instance}.statistics")
    path.write_bytes(header + bytes(100_000))
    for verb in ("status", "ls", "health"):
        done = shmmap.run(verb)
        assert (done.returncode, done.stdout) == (65, "")
        assert "statistics 1.5 of an older daemon: this program reads 3.x" in done.stderr
        assert "update the daemon" in done.stderr
    one.start()
    assert shmmap.json("status")["state"] == "healthy"
