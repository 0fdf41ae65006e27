# SPDX-License-Identifier: Apache-2.0
"""The worker's process: every request is answered, and what it keeps is its own."""

from __future__ import annotations

import os
import socket
import threading
from pathlib import Path

import pytest

from shmmap.chunks.applying import UNDO_BYTES
from shmmap.daemon.live import messages
from shmmap.daemon.live.worker.main import HEARD_AT_ONCE, _record, _Worker
from shmmap.errors import CannotStart
from shmmap.processes.start_child import channel, packet_buffer, receive_packet
from shmmap.protocol.codec import decode_reply, encode
from shmmap.protocol.live import LiveList, LiveOpen
from shmmap.protocol.messages import ErrorReply
from tests.support.accounts import MEMBER


def test_answers_wait_for_a_daemon_that_is_busy() -> None:
    """It hears nothing for a while, and the channel is full: no answer is lost."""
    ours, theirs = channel()
    buffer = packet_buffer()
    with ours, theirs:
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 0)  # the least there is
        worker = _Worker(theirs)
        for ticket in range(HEARD_AT_ONCE):
            message = LiveList(ticket) if ticket % 2 else LiveOpen(ticket, "x" * 60)
            ours.send(messages.encode(messages.Ask(ticket, 1, 0, True, encode(message))))
        hearing = threading.Thread(target=worker._hear)
        hearing.start()
        hearing.join(0.2)  # until it can send no more
        for ticket in range(HEARD_AT_ONCE):
            answer = messages.decode_from_live(receive_packet(ours, buffer)[0])
            assert isinstance(answer, messages.Answer)
            assert answer.ticket == ticket
            assert isinstance(decode_reply(answer.body), ErrorReply) != bool(ticket % 2)
        hearing.join()
        os.close(worker._done)


def test_the_undo_record_is_made_and_found_again(tmp_path: Path) -> None:
    path = tmp_path / "undo"
    _record(str(path), UNDO_BYTES)[100:103] = b"abc"
    assert (path.stat().st_size, path.stat().st_mode & 0o777) == (UNDO_BYTES, 0o600)
    assert bytes(_record(str(path), UNDO_BYTES)[100:103]) == b"abc"


@pytest.mark.root
def test_an_undo_record_of_somebody_else_is_not_used(tmp_path: Path) -> None:
    """Who could write it would write chunks."""
    path = tmp_path / "undo"
    path.write_bytes(bytes(UNDO_BYTES))
    os.chown(path, MEMBER, -1)
    with pytest.raises(CannotStart, match=f"but of user {MEMBER}"):
        _record(str(path), UNDO_BYTES)


def test_a_pipe_or_a_link_is_no_undo_record(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(CannotStart, match="is not a file"):
        _record(str(tmp_path / "pipe"), UNDO_BYTES)
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="symbolic links"):
        _record(str(tmp_path / "link"), UNDO_BYTES)
    assert not (tmp_path / "elsewhere").exists()
