# SPDX-License-Identifier: Apache-2.0
"""Start a program while the other threads of this process run.

`subprocess` holds the interpreter lock until the child runs its program.  On a busy machine the child waits
for a processor before that, and all threads here would wait with it: for tenths of a second.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from typing import Final

_LIBC: Final = ctypes.CDLL(None)
_FileActions: Final = ctypes.c_long * 32
"""A posix_spawn_file_actions_t is smaller."""


def start_program(
    command: Sequence[str], environment: Mapping[str, str], output: int, inherited: Sequence[int] = ()
) -> int:
    """Start a program, which reads nothing and whose errors are discarded; return its process id.

    Parameters
    ----------
    command
        Absolute path of the program, and its arguments.
    output
        Descriptor of its standard output.
    inherited
        Further descriptors, which it has under the same numbers.

    Raises
    ------
    OSError
        The program cannot be started.
    """
    arguments = _strings(command)
    variables = _strings([f"{name}={value}" for name, value in environment.items()])
    nothing, actions, pid = os.fsencode(os.devnull), _FileActions(), ctypes.c_int()
    _check(_LIBC.posix_spawn_file_actions_init(actions))
    try:
        for fd in inherited:  # glibc before 2.29 still closes a descriptor that is duplicated onto itself
            _check(_LIBC.posix_spawn_file_actions_adddup2(actions, fd, 2))
            _check(_LIBC.posix_spawn_file_actions_adddup2(actions, 2, fd))
        _check(_LIBC.posix_spawn_file_actions_adddup2(actions, output, 1))
        for fd, mode in ((0, os.O_RDONLY), (2, os.O_WRONLY)):
            _check(_LIBC.posix_spawn_file_actions_addopen(actions, fd, nothing, mode, 0))
        _check(_LIBC.posix_spawn(ctypes.byref(pid), arguments[0], actions, None, arguments, variables))
    finally:
        _LIBC.posix_spawn_file_actions_destroy(actions)
    return pid.value


def _strings(values: Sequence[str]) -> ctypes.Array[ctypes.c_char_p]:
    """Return strings as a C program's arguments."""
    return (ctypes.c_char_p * (len(values) + 1))(*map(os.fsencode, values))


def _check(error: int) -> None:
    if error:
        raise OSError(error, os.strerror(error))
