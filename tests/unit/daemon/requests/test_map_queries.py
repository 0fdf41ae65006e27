# SPDX-License-Identifier: Apache-2.0
"""Pages of the catalogue: whatever the area, all its cells come, once each, and no page takes long."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.requests import map_queries
from shmmap.daemon.requests.map_queries import MapQueries
from shmmap.geometry import Area, Box, Circle
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.messages import Metadata, MetadataPage, area_to_message
from shmmap.segment.layout import SourceStamp

SIDE = 12


def catalogue() -> Catalogue:
    """Cells whose ids have another order than their places."""
    places = np.random.default_rng(1).permutation(SIDE * SIDE)
    return Catalogue.from_cells(
        (f"/m/{n:04}.pcd", (20.0 * x, 20.0 * y, 20.0 * x + 20, 20.0 * y + 20), SourceStamp(1, n, 1))
        for n, (x, y) in enumerate(divmod(int(place), SIDE) for place in places)
    )


MAP = catalogue()


class _Cache:
    """What pages need of a cache."""

    epoch = 1
    heights: dict[int, tuple[float, float]] = {}  # noqa: RUF012
    catalogue = MAP
    index_of = staticmethod(MAP.find)

    @staticmethod
    def wire_id(cell: str) -> str:
        return cell


def all_pages(area: Area, limit: int) -> list[MetadataPage]:
    queries: Any = MapQueries(*[cast("Any", None)] * 7)
    queries.cache = _Cache
    start: int | None = 0
    pages = []
    while start is not None:
        pages.append(queries.page(Metadata(1, area_to_message(area), None, start, limit)))
        start = pages[-1].next
        assert len(pages) < 1000
    return pages


areas = st.one_of(
    st.builds(Circle, st.floats(-50, 300), st.floats(-50, 300), st.floats(0, 400)),
    st.builds(
        lambda x, y, w, h: Box(x, y, x + w, y + h),
        st.floats(-50, 300), st.floats(-50, 300), st.floats(0, 400), st.floats(0, 400),
    ),
)  # fmt: skip


@given(area=areas, limit=st.integers(1, 60), looked_at=st.integers(1, 200))
def test_all_cells_once_in_order(area: Area, limit: int, looked_at: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_queries, "LOOKED_AT", looked_at)
        pages = all_pages(area, limit)
    assert [row.id for page in pages for row in page.rows] == MAP.ids(MAP.query(area)[0])
    assert max(len(page.rows) for page in pages) <= limit
    assert len(pages) <= SIDE * SIDE // looked_at + SIDE * SIDE // limit + 2
