# SPDX-License-Identifier: Apache-2.0
"""A child process from its first instruction on; packets with and without a descriptor, into one buffer."""

from __future__ import annotations

import os
import re
import signal
import socket
import tracemalloc
from pathlib import Path

import pytest

from shmmap.processes.start_child import MAX_PACKET_BYTES, channel, packet_buffer, receive_packet, start_child


@pytest.mark.parametrize("new_session", [False, True])
def test_ctrl_c_cannot_end_a_child_in_its_imports(new_session: bool) -> None:
    process, channel = start_child("shmmap.prepare.worker", "/nowhere", "0", new_session=new_session)
    try:
        status = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
    finally:
        channel.close()
        process.kill()
        process.wait()
    found = re.search(r"^SigBlk:\s*([0-9a-f]+)$", status, re.MULTILINE)
    assert found is not None
    assert int(found[1], 16) & 1 << signal.SIGINT - 1
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ()), "the parent gets it"


def test_a_descriptor_comes_with_its_packet_and_is_not_inherited() -> None:
    ours, theirs = channel()
    read, write = os.pipe()
    buffer = packet_buffer()
    with ours, theirs:
        ours.send(b"first")
        socket.send_fds(ours, [b"second"], [write])
        data, fd = receive_packet(theirs, buffer)
        assert (bytes(data), fd) == (b"first", -1)
        data, fd = receive_packet(theirs, buffer)
        assert bytes(data) == b"second"
        assert not os.get_inheritable(fd)
        os.write(fd, b"x")
        assert os.read(read, 1) == b"x"
        ours.close()
        data, none = receive_packet(theirs, buffer)
        assert (len(data), none) == (0, -1)
    for one in (read, write, fd):
        os.close(one)


def test_of_several_descriptors_only_one_comes() -> None:
    """A loader that has gone mad must not fill the daemon's table."""
    ours, theirs = channel()
    with ours, theirs:
        before = len(os.listdir("/proc/self/fd"))
        socket.send_fds(ours, [b"x"], [0] * 10)
        _, fd = receive_packet(theirs, packet_buffer())
        after = len(os.listdir("/proc/self/fd"))
        os.close(fd)
    assert after - before == 1


def test_the_longest_packet_arrives_both_ways_and_short_ones_take_no_memory() -> None:
    ours, theirs = channel()
    buffer = packet_buffer()
    with ours, theirs:
        longest = bytes(MAX_PACKET_BYTES - 1024)
        ours.send(longest)
        assert receive_packet(theirs, buffer)[0] == longest
        theirs.send(longest)
        assert receive_packet(ours, buffer)[0] == longest
        theirs.setblocking(False)
        with pytest.raises(BlockingIOError):
            receive_packet(theirs, buffer)
        ours.send(b"short")
        tracemalloc.start()
        receive_packet(theirs, buffer)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < 1 << 16


def test_a_receive_without_wait_leaves_the_channel_blocking() -> None:
    ours, theirs = channel()
    buffer = packet_buffer()
    with ours, theirs:
        with pytest.raises(BlockingIOError):
            receive_packet(theirs, buffer, wait=False)
        assert theirs.getblocking()
        ours.send(b"one")
        assert bytes(receive_packet(theirs, buffer, wait=False)[0]) == b"one"
