# SPDX-License-Identifier: Apache-2.0
"""Clients that say where they are, without sockets."""

from __future__ import annotations

from shmmap.daemon.transport.sessions import Session
from shmmap.protocol.messages import Intent

__all__ = ["says"]


def says(session: Session, intent: Intent, now_s: float) -> None:
    """Do what the daemon does when a request with an intent comes."""
    session.state_intent(intent)
    session.last_request_s = now_s
