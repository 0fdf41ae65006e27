# SPDX-License-Identifier: Apache-2.0
"""An archive that is interrupted at any call raises the interrupt and nothing else."""

from __future__ import annotations

import gc
import io
import signal
import sys
from types import FrameType
from typing import Any

import numpy as np
import pytest

from shmmap.formats.npz_writer import write_npz

ARRAYS = {"file": np.arange(3), "x": np.ones((2, 2))}


def test_arrays_of_any_name_are_read_by_numpy() -> None:
    file = io.BytesIO()
    write_npz(file, ARRAYS)
    file.seek(0)
    with np.load(file, allow_pickle=False) as read:
        assert {name: read[name].tolist() for name in read} == {
            name: values.tolist() for name, values in ARRAYS.items()
        }


def interrupted_at(number: int) -> bool:
    """Press Ctrl-C in the call of this number below `write_npz`; whether it came to that."""
    calls = 0

    def count(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal calls
        if event == "call" and frame.f_code.co_name != "__del__":
            calls += 1
            if calls == number:
                sys.setprofile(None)
                signal.raise_signal(signal.SIGINT)

    file = io.BytesIO()
    sys.setprofile(count)
    try:
        write_npz(file, ARRAYS)
    finally:
        sys.setprofile(None)
        file.close()
    return calls >= number


def test_an_interrupt_at_any_call_is_the_only_error(monkeypatch: pytest.MonkeyPatch) -> None:
    ignored: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda unraisable: ignored.append(unraisable.exc_value))
    number = 1
    while True:
        try:
            if not interrupted_at(number):
                break
        except KeyboardInterrupt as error:
            assert error.__context__ is None  # noqa: PT017
        number += 1
    gc.collect()
    assert number > 50
    # Python reports an interrupt within a finalizer by itself; since 3.14 also that zipfile cannot finalize
    # what an interrupt left half made in its constructor
    own = KeyboardInterrupt if sys.version_info < (3, 14) else (KeyboardInterrupt, AttributeError)
    assert [error for error in ignored if not isinstance(error, own)] == []
