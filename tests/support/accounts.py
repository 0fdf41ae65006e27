# SPDX-License-Identifier: Apache-2.0
"""User accounts that need not exist: numbers are enough for the kernel.  And what one may try with a file."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support.daemon_process import ROOT

DAEMON_UID, GROUP, MEMBER, OTHER_USER, ADMINS = 61001, 61002, 61003, 61004, 61005


def as_user(uid: int, gid: int, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command as another account, without any other group."""
    return subprocess.run(
        ["setpriv", f"--reuid={uid}", f"--regid={gid}", "--clear-groups", "--inh-caps=-all", *command],
        capture_output=True,
        text=True,
        cwd="/",
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT)},
    )


def python_for_others() -> str:
    """Path of a Python that other accounts can start; the test is skipped where there is none."""
    own = os.path.realpath(sys.executable)  # the environment itself may not be open to others
    for python in (own, "/usr/bin/python3"):
        if (
            os.path.exists(python)
            and not as_user(OTHER_USER, OTHER_USER, python, "-I", "-c", "import json").returncode
        ):
            return python
    pytest.skip("this Python cannot be started by other accounts")


# A program that tries to do harm to a file of the daemon, and says how far it came


ATTEMPTS = """
import ctypes, fcntl, json, mmap, os, sys
path = sys.argv[1]

def attempt(action):
    try:
        action()
    except OSError as error:
        return error.errno
    except ValueError as error:
        return str(error)
    return 0

def read():
    fd = os.open(path, os.O_RDONLY)
    with mmap.mmap(fd, 0, prot=mmap.PROT_READ) as mapped:
        assert mapped[:6] == b"SHMMAP"
    os.close(fd)

def from_reader(action):
    def run():
        fd = os.open(path, os.O_RDONLY)
        try:
            action(fd)
        finally:
            os.close(fd)
    return run

def protect(fd):
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t] + [ctypes.c_int] * 3 + [ctypes.c_long]
    address = libc.mmap(None, 4096, 1, 1, fd, 0)
    if libc.mprotect(ctypes.c_void_p(address), 4096, 3):
        raise OSError(ctypes.get_errno(), "mprotect")

print(json.dumps({
    "read": attempt(read),
    "open for writing": attempt(lambda: os.open(path, os.O_RDWR)),
    "truncate": attempt(lambda: os.truncate(path, 0)),
    "unlink": attempt(lambda: os.unlink(path)),
    "rename": attempt(lambda: os.rename(path, path + "x")),
    "chmod": attempt(lambda: os.chmod(path, 0o666)),
    "utime": attempt(lambda: os.utime(path, ns=(1, 1))),
    "writable mapping": attempt(from_reader(lambda fd: mmap.mmap(fd, 0, prot=3))),
    "mprotect": attempt(from_reader(protect)),
    "ftruncate": attempt(from_reader(lambda fd: os.ftruncate(fd, 0))),
    "reopen": attempt(from_reader(lambda fd: os.open(f"/proc/self/fd/{fd}", os.O_RDWR))),
    "lease": attempt(from_reader(lambda fd: fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_WRLCK))),
}))
"""
