# SPDX-License-Identifier: Apache-2.0
"""Waiting for a device, with a limit: commands are polled, so that a device that hangs blocks no program."""

from __future__ import annotations

import ctypes
import time
from typing import Any, Final

from shmmap_clients.ndt_scan_matcher.backends.opencl.errors import DeviceError, DeviceHung

__all__ = ["TIMEOUT_S", "Waiting"]

TIMEOUT_S: Final = 10.0  # for any command, where no deadline is nearer
_NAP_S: Final = 20e-6


class Waiting:
    """Waits for events of one device.

    It sleeps for most of the time that the last wait took, then looks again and again: a wait costs the
    processor little, and ends microseconds after the event.

    Parameters
    ----------
    device
        Its name, for errors.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._usual_s = 0.0

    def until(self, event: Any, deadline_s: float | None = None) -> None:
        """Wait until a command has ended.

        Parameters
        ----------
        event
            Of the command; its queue has been flushed.
        deadline_s
            Of `time.monotonic`; None: `TIMEOUT_S` from now.

        Raises
        ------
        DeviceHung
            It has not ended then.
        DeviceError
            It failed.
        """
        began_s = time.monotonic()
        latest_s = began_s + TIMEOUT_S
        if deadline_s is not None:
            latest_s = min(latest_s, deadline_s)
        if self._usual_s > 4 * _NAP_S and not _ended(event):
            time.sleep(min(0.6 * self._usual_s, max(latest_s - began_s, 0.0)))
        while not _ended(event):
            if time.monotonic() >= latest_s:
                _never_free(event)
                raise DeviceHung(
                    f"device {self._device!r} has not answered within {time.monotonic() - began_s:.3f} s",
                    hint="a higher --deadline gives it more time; --fallback numba goes on without it",
                )
            time.sleep(_NAP_S)
        status = event.command_execution_status
        if status < 0:
            raise DeviceError(f"device {self._device!r} failed: OpenCL error {status}")
        took_s = time.monotonic() - began_s
        self._usual_s = min(took_s, 0.9 * self._usual_s + 0.1 * took_s) if self._usual_s else took_s


def _ended(event: Any) -> bool:
    return bool(event.command_execution_status <= 0)  # CL_COMPLETE is 0, an error is negative


def _never_free(event: Any) -> None:
    """Keep an event: to free one of a hung device is to wait for it, even when the process ends."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(event))
