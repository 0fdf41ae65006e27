# SPDX-License-Identifier: Apache-2.0
"""Show the daemon's map to browsers, as it is now: one loop that asks the daemon and sends to each page.

What a viewer asks for must cost clients nothing: it says neither position nor area, so that nothing is
fetched ahead for it; its requests are ``spare``, so that the daemon loads for it only when it is idle, into
memory that is free, and evicts that first; and it unmaps a cell as soon as its points are on their way.
"""

from __future__ import annotations

import html
import math
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import DaemonUnreachable, NoColumn, ShmmapError
from shmmap.geometry import Box
from shmmap.viewing.browser.cell_points import Colours, Ground, blocks
from shmmap.viewing.browser.detail import LEAVES, Changes, Sizes, changes, choose, layer_of
from shmmap.viewing.browser.page import NO_CLIENT, Page, Place
from shmmap.viewing.page import HEIGHT, follower_of
from shmmap.viewing.sources import BoxTuple, values_of

if TYPE_CHECKING:
    import viser

    from shmmap.client.cell import Cell
    from shmmap.client.cell_set import CellSet
    from shmmap.client.client import Client
    from shmmap.protocol.rows import ClientRow

_STATE_S: Final = 0.1  # how often clients are looked at
_CHUNKS_S: Final = 1.0
_PLAN_S: Final = 0.25
_WAIT_S: Final = 0.25  # how long the daemon may load what a page needs next
_PENDING_S: Final = 0.1  # before a cell that was not loaded is asked for again
_FAILED_S: Final = 5.0
_BATCH: Final = 16
_MAX_CHUNKS: Final = 400
_LITTLE: Final = 8 << 20  # with less free memory, the daemon may have no room for a cell
_IDLE_S: Final = 0.03
_AGAIN_S: Final = 0.5  # between two tries to reach the daemon
_START_M: Final = (120.0, 40.0)  # at first, how far from what one looks at: at most, at least


class _Map:
    """The map's list of cells, as arrays."""

    def __init__(self, client: Client) -> None:
        listing = client.metadata()
        self.version = listing.map_version
        infos = list(listing)
        self.ids = [one.id for one in infos]
        self.boxes = listing.boxes
        self.z = np.array([one.z_bounds or (math.nan, math.nan) for one in infos]).reshape(-1, 2)
        self.versions = np.array([one.version for one in infos], np.uint64)
        self.sizes = Sizes(self.boxes, np.array([one.source_bytes for one in infos], np.float64))
        self.numbers = {cell: number for number, cell in enumerate(self.ids)}


class LiveView:
    """Serves pages until it is closed.

    Parameters
    ----------
    client
        A session of its own.
    server
        Where browsers connect.
    by
        What colours mean, as in `shmmap.viewing.page.View`.
    follow
        Name of the client to follow at first, or None.
    area
        Where to look at first; None: at the followed client, any client, or the middle of the map.
    """

    def __init__(
        self,
        client: Client,
        server: viser.ViserServer,
        *,
        by: str = HEIGHT,
        follow: str | None = None,
        area: BoxTuple | None = None,
    ) -> None:
        self._client = client
        self._server = server
        self._follow = follow or NO_CLIENT
        self._area = area
        self._colours = Colours(by)
        self._meaning = {HEIGHT: "height above ground, m", "z": "z, m"}.get(by, by)
        self._ground = Ground()
        self._map = _Map(client)
        self._rows: Sequence[ClientRow] = ()
        self._windows: list[BoxTuple] = []
        self._chunks: dict[Any, tuple[float, float, float, float, float, float]] = {}
        self._changes: dict[str, int] = {}  # of live maps, when their chunks were listed
        self._free_bytes = 0
        self._pages: dict[int, Page] = {}
        self._plans: dict[int, tuple[float, Changes]] = {}
        self._problem = ""
        self._state_s = self._chunks_s = self._retry_s = 0.0
        start, away = self._start()
        self._origin = start
        camera = server.initial_camera
        camera.far, camera.near = 20_000.0, 0.2
        camera.position, camera.look_at = (-0.6 * away, -0.6 * away, 0.7 * away), (0.0, 0.0, 0.0)

    # --- the loop -------------------------------------------------------------------------------

    def run(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Serve until ``is_over``.

        Raises
        ------
        NoColumn
            The cells have no such column to colour by.
        """
        while not is_over():
            if not self.step():
                time.sleep(_IDLE_S)

    def step(self) -> bool:
        """Do some work for each page; return whether there is more."""
        now_s = time.monotonic()
        self._meet()
        if now_s < self._retry_s or not self._pages:
            return False
        try:
            self._look(now_s)
            more = [self._serve(number, page, now_s) for number, page in self._pages.items()]
            self._problem = ""
        except NoColumn:
            raise
        except ShmmapError as error:
            gone = isinstance(error, DaemonUnreachable)
            self._problem = "the daemon is gone; waiting for it" if gone else error.message
            self._retry_s = time.monotonic() + _AGAIN_S
            more = []
        for number, page in self._pages.items():
            plan = self._plans.get(number)
            page.say(
                self._problem, self._colours, html.escape(self._meaning), len(plan[1].wanted) if plan else 0
            )
        return any(more)

    def _meet(self) -> None:
        """Note the browsers that have come and gone."""
        browsers = self._server.get_clients()
        for number in self._pages.keys() - browsers.keys():
            del self._pages[number]
            self._plans.pop(number, None)
        for number in browsers.keys() - self._pages.keys():
            title = self._client.welcome.map_path
            self._pages[number] = Page(browsers[number], self._origin, self._follow, title)
            self._state_s = 0.0
            self._chunks_s = 0.0

    # --- what there is --------------------------------------------------------------------------

    def _look(self, now_s: float) -> None:
        """Look at the daemon's clients, memory and map."""
        if now_s >= self._state_s + _STATE_S:
            self._state_s = now_s
            stats = self._client.stats()
            used = ("bytes_resident", "bytes_zombie", "bytes_reserved", "bytes_statistics")
            self._free_bytes = stats.counters.get("budget_bytes", 0) - sum(
                stats.counters.get(name, 0) for name in used
            )
            self._rows = stats.sessions
            if stats.map_version != self._map.version:
                self._take_map()
            self._mark()
        if now_s >= self._chunks_s + _CHUNKS_S:
            self._chunks_s = now_s
            self._chunks = self._live_chunks()
            for page in self._pages.values():
                page.outline(self._chunks)

    def _take_map(self) -> None:
        """Take another state of the map: cells keep what they show until their new version is here."""
        old, self._map = self._map, _Map(self._client)
        numbers = [self._map.numbers.get(cell) for cell in old.ids]
        if numbers == list(range(len(old.ids))) and len(self._map.ids) == len(old.ids):
            return
        self._ground.forget()
        for page in self._pages.values():
            page.drop([cell for cell in page.shown if numbers[cell] is None])
            page.shown = {n: one for cell, one in page.shown.items() if (n := numbers[cell]) is not None}
            page.choice = None
            page.retry_s.clear()

    def _mark(self) -> None:
        mine = self._client.welcome.session
        found = [one for row in self._rows if row.session != mine and (one := follower_of(row)) is not None]
        self._windows = [one.box for one in found if one.box is not None]
        newest = {one.name: one for one in found}  # of one name, the one that came last
        clients = [(one, self._height(one.x, one.y)) for one in newest.values()]
        for page in self._pages.values():
            page.mark(clients)
            if page.followed != NO_CLIENT and (one := newest.get(page.followed)) is not None:
                page.go_to((one.x, one.y, self._height(one.x, one.y)))

    def _height(self, x: float, y: float) -> float:
        return self._ground.height(x, y, self._origin[2])

    def _live_chunks(self) -> dict[Any, tuple[float, float, float, float, float, float]]:
        """Return the boxes of chunks in memory; only maps that have changed are asked for theirs."""
        found: dict[Any, tuple[float, float, float, float, float, float]] = {}
        for row in self._client.live_maps():
            if self._changes.get(row.name) == row.change:
                found |= {key: box for key, box in self._chunks.items() if key[0] == row.name}
                continue
            live = self._client.live(row.name)
            for chunk in live.chunks()[:_MAX_CHUNKS]:
                found[row.name, chunk.key] = chunk.key.box(live.resolution)
            self._changes[row.name] = row.change
        return found

    def _start(self) -> tuple[Place, float]:
        """Return where to look at first, and how far from it the eye is."""
        most, least = _START_M
        box = self._area
        rows = self._client.stats().sessions
        clients = [one for row in rows if (one := follower_of(row)) is not None]
        named = [one for one in clients if one.name == self._follow] or (clients if box is None else [])
        z = self._map.z[np.isfinite(self._map.z).all(axis=1)]
        ground = float(np.median(z[:, 0])) if len(z) else 0.0
        if named:
            return (named[-1].x, named[-1].y, ground), least
        box = box or self._client.bounds or (0.0, 0.0, 1.0, 1.0)
        span = max(box[2] - box[0], box[3] - box[1])
        x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
        if self._area is None and len(self._map.boxes):  # the middle may be empty
            centres = (self._map.boxes[:, :2] + self._map.boxes[:, 2:]) / 2
            x, y = centres[np.hypot(centres[:, 0] - x, centres[:, 1] - y).argmin()].tolist()
        return (x, y, ground), min(max(span, least), most)

    # --- a page ---------------------------------------------------------------------------------

    def _serve(self, number: int, page: Page, now_s: float) -> bool:
        """Send a page what it needs next; return whether there is more."""
        planned_s, plan = self._plans.get(number, (0.0, Changes()))
        eye = page.eye()
        if now_s >= planned_s + _PLAN_S or page.choice is None:
            the_map = self._map
            page.choice = choose(eye, the_map.boxes, the_map.z, the_map.sizes, page.most_points, page.choice)
            plan = changes(page.as_shown(), page.choice, the_map.versions)
            self._plans[number] = now_s, plan
            page.drop(plan.gone)
            plan = Changes([], plan.wanted)
        if page.is_busy():
            return False
        due = page.due(plan, now_s)[:_BATCH]
        if not due:
            return False
        done = self._fetch(page, due)
        plan = Changes([], [one for one in plan.wanted if one[0] not in done])
        self._plans[number] = self._plans[number][0], plan
        return bool(plan.wanted)

    def _fetch(self, page: Page, due: list[tuple[int, int]]) -> set[int]:
        """Fetch some cells of one level and show those that are there; return their numbers."""
        level = due[0][1]
        found = self._ask([self._map.ids[cell] for cell, _ in due], layer_of(level), _WAIT_S)
        done = self._show(page, found, level)
        retry_s = time.monotonic()
        for failed in found.failed:
            if (cell := self._map.numbers.get(failed.cell_id)) is not None:
                page.retry_s[cell] = retry_s + _FAILED_S
        lacking = [cell for cell, _ in due if cell not in done]
        for cell in lacking:
            page.retry_s[cell] = max(page.retry_s.get(cell, 0.0), retry_s + _PENDING_S)
        del found
        done |= self._substitute(page, [cell for cell in lacking if cell not in page.shown], level)
        self._client.release()
        return done

    def _substitute(self, page: Page, cells: list[int], level: int) -> set[int]:
        """Show cells by their points, thinned, meanwhile: the daemon is busy, or has no room for more.

        Where a client is, the points are in memory.  Elsewhere they are only where memory is short.
        """
        if self._free_bytes >= _LITTLE:
            cells = [cell for cell in cells if self._is_followed(cell)]
        if not cells:
            return set()
        found = self._ask([self._map.ids[cell] for cell in cells], "points", 0.0)
        done = self._show(page, found, level, is_whole=False)
        retry_s = time.monotonic() + (_AGAIN_S if self._free_bytes >= _LITTLE else _FAILED_S)
        page.retry_s.update(dict.fromkeys(done, retry_s))
        return done

    def _is_followed(self, cell: int) -> bool:
        """Whether a client's window touches a cell."""
        return any(Box(*box).overlaps(self._map.boxes[cell : cell + 1])[0] for box in self._windows)

    def _ask(self, ids: list[str], layer: str, wait_s: float) -> CellSet:
        """Ask for cells as one who must not be in anyone's way."""
        session = self._client.session
        return session.run(session.selected(tuple(ids), (layer,), wait_s, spare=True))

    def _show(self, page: Page, found: CellSet, level: int, *, is_whole: bool = True) -> set[int]:
        """Put cells on a page; each is unmapped again."""
        done: set[int] = set()
        ready: list[tuple[int, NDArray[np.float64], NDArray[Any] | None]] = []
        for cell in found.cells:
            number = self._map.numbers.get(cell.id)
            if number is None:
                continue
            every = 1
            if is_whole:
                self._map.sizes.note(number, level, cell.points)
            else:
                least = self._map.sizes.points(np.array([number]), np.array([level]))[0]
                every = max(1, math.ceil(cell.points / max(least, 1.0)))
            xyz, column = _points(cell, self._colours.column, every)
            self._ground.add(number, xyz)
            ready.append((number, xyz, column))
            done.add(number)
            if cell.stale:  # its new version is being loaded
                page.retry_s[number] = time.monotonic() + _AGAIN_S
            self._map.z[number] = cell.z_bounds
        stale = {self._map.numbers.get(cell.id) for cell in found.cells if cell.stale}
        surfaces = {
            number: self._ground.surface(_box(self._map.boxes[number]))
            if self._colours.by == HEIGHT
            else None
            for number, _, _ in ready
        }
        values = {
            number: self._colours.values(xyz, column, surfaces[number]) for number, xyz, column in ready
        }
        changed = [self._colours.settle(one) for one in values.values()]
        if True in changed:
            for other in self._pages.values():
                other.repaint()
        for number, xyz, _ in ready:
            page.put(
                number,
                level,
                int(self._map.versions[number]),
                blocks(xyz, self._colours.of(values[number]), LEAVES[level]),
                is_whole=is_whole and number not in stale,
            )
        return done


def _points(cell: Cell, column: str, every: int) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
    """Return a cell's points, (N, 3) metres in the map frame, and a column; in memory of this process."""
    where = f"{cell.name}: layer {cell.layer}"
    values = values_of(cell.columns, column, cell.points, where)
    xyz = cell.xyz[::every].astype(np.float64) + cell.origin
    good = np.isfinite(xyz).all(axis=1)
    picked = None if values is None else np.array(values[::every])
    return (xyz, picked) if good.all() else (xyz[good], None if picked is None else picked[good])


def _box(row: NDArray[np.float64]) -> BoxTuple:
    min_x, min_y, max_x, max_y = row.tolist()
    return min_x, min_y, max_x, max_y
