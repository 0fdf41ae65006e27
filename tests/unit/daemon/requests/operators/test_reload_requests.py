# SPDX-License-Identifier: Apache-2.0
"""A reload that takes long is asked for once, however often the client repeats itself."""

from __future__ import annotations

import select
from collections.abc import Callable

from shmmap.daemon.map.catalogue_reload import Reloader, Reread
from shmmap.daemon.requests.operators.operator_pins import OperatorPins
from shmmap.daemon.requests.operators.operator_requests import OperatorRequests
from shmmap.errors import ShmmapError
from shmmap.origin.map_directory import open_map
from shmmap.protocol.messages import Reload, Reloaded
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import InnerDaemon, finish


def test_a_repeated_request_is_one(inner: Callable[..., InnerDaemon], small_map: DividedMap) -> None:
    one = inner(small_map.root)
    reloader = Reloader(open_map(str(small_map.root)), lambda: one.cache.catalogue)
    operators = OperatorRequests(one.cache, OperatorPins(one.cache, one.scheduler), reloader)
    session = one.session()
    read: list[Reread] = []
    failed: list[ShmmapError] = []
    for number in (7, 7, 7, 8):
        finish(operators.handle(session, Reload(number), 0.0))

    def apply(found: Reread) -> Reread:
        read.append(found)
        return found

    def collect() -> None:
        assert select.select([reloader.fd], [], [], 30.0)[0]
        reloader.collect(apply, failed.append)

    collect()
    assert [(type(reply), reply.request) for _, reply in one.replies] == [(Reloaded, 7)]
    finish(operators.handle(session, Reload(7), 0.0))  # answered: this is another one
    collect()
    collect()
    assert [reply.request for _, reply in one.replies] == [7, 8, 7]
    assert (len(read), failed) == (3, [])
    reloader.close()
