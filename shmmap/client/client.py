# SPDX-License-Identifier: Apache-2.0
"""`Client`: one process's session with the daemon."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial, wraps
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, Final, NoReturn, ParamSpec, TypeVar

import numpy as np

import shmmap.geometry as geometry
from shmmap.client.arguments import given_intent, names, request_waits, timeout_s
from shmmap.client.cell_set import CellSet, Held, HeldCells
from shmmap.client.connection import until_served
from shmmap.client.discovery import candidates
from shmmap.client.session import Session, Steps
from shmmap.client.session_state import SessionState
from shmmap.errors import warn_program
from shmmap.installed import remember_modules
from shmmap.lazy_imports import know_names
from shmmap.protocol import messages
from shmmap.segment.process_limits import no_files_left

if TYPE_CHECKING:
    from concurrent.futures import Future

    from numpy.typing import NDArray

    from shmmap.client.live.live_map import LiveMap
    from shmmap.client.map_listing import MapListing
    from shmmap.client.points_around import PointsAround
    from shmmap.protocol.live import LiveMapRow

P = ParamSpec("P")
R = TypeVar("R")

DEFAULT_WAIT_S: Final = 5.0
CONNECT_S: Final = 60.0
RELOAD_S: Final = 60.0
RELOAD_CELL_S: Final = 60e-6
"""Extra time for reading a map's catalogue: a fixed part, and a part per cell."""


class Client(SessionState):
    """A session with the daemon; get one from `connect`.

    Several threads may use a client: no request waits for another one's answer.

    After a fork the child gets a session of its own with its first request.  Cells attached before
    stay readable in it; until the child drops them or ends, the daemon counts them as in use by the
    parent.  The parent notices nothing.

    Every request has a deadline: ``timeout`` plus the time that the request lets the daemon wait.  It is
    repeated on silence.  After a restart of the daemon the client begins a new session without any error.
    """

    def __init__(
        self,
        paths: Sequence[str],
        *,
        timeout: float,
        connect_timeout: float,
        name: str,
        shm_dir: str,
    ) -> None:
        self._session = Session(
            paths, timeout_s=timeout, connect_timeout_s=connect_timeout, name=name, shm_dir=shm_dir
        )

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Client of {self.endpoint}, map {self.welcome.map_path}>"

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a Client cannot be pickled: it is this process's connection to the daemon. Connect in each"
            " process, shmmap.connect(...); a child that is forked may use it as it is. Cells can be pickled:"
            " they go as handles"
        )

    def close(self) -> None:
        """End the session; attached cells stay readable."""
        self._session.close()

    # --- cells ------------------------------------------------------------------------------------

    def around(
        self,
        x: float,
        y: float,
        radius: float = 50.0,
        *,
        layers: str | Sequence[str] = ("points",),
        z: tuple[float, float] | None = None,
        wait: float | None = DEFAULT_WAIT_S,
        strict: bool | None = False,
    ) -> CellSet:
        """Return the cells that touch a circle of ``radius`` metres, as whole cells; `area` with a circle."""
        return self.area(geometry.Circle(x, y, radius, z), layers, wait=wait, strict=strict)

    def area(
        self,
        area: geometry.Area,
        layers: str | Sequence[str] = ("points",),
        *,
        wait: float | None = DEFAULT_WAIT_S,
        pose: Sequence[float] | None = None,
        velocity: Sequence[float] = (0.0, 0.0),
        heading: float | None = None,
        route: Sequence[tuple[float, float]] | NDArray[Any] = (),
        strict: bool | None = False,
    ) -> CellSet:
        """Return the cells that touch an area, in id order.

        A `ShmmapWarning` reports an incomplete answer: cells failed, cells are still being loaded after
        ``wait``, or there are no cells at all.

        Parameters
        ----------
        area
            `Circle`, `Box` or `AutowareSquare`; metres, map frame.
        layers
            Layers to return of each cell.
        wait
            Seconds the daemon may take to load cells that are not in memory.  0 or None: return the cells in
            memory, and list the others in `CellSet.pending`.  `math.inf`: until nothing is pending.
        pose, velocity, heading, route
            Pose and motion of this process, (x, y) in metres, map frame, as in `MapWindow.move_to`.  The
            daemon prefetches the cells that the process will need next, and keeps nearby cells.
        strict
            True: raise an error instead of a warning.  None: do neither, the program checks `CellSet.failed`
            and `CellSet.pending` itself.

        Raises
        ------
        CellError
            With ``strict``: the error of the first cell that failed, `LoadTimeout` for a cell that is still
            being loaded, or `UnknownCell` if the area has no cells.
        NoAnswer
            No reply before the deadline.
        BadRequest
            The area or a layer is invalid.
        SegmentError
            This user may not read the segments, or the process has no room for more mappings.
        """
        specs, sent = names("layers", layers), given_intent(pose, velocity, heading, route)
        ask = partial(self._session.area, area, specs, intent=sent)
        return self._run(self._answer(ask, area, wait, strict))

    def points_around(
        self,
        x: float,
        y: float,
        radius: float,
        *,
        layer: str = "points",
        z: tuple[float, float] | None = None,
        wait: float | None = DEFAULT_WAIT_S,
        strict: bool | None = False,
    ) -> PointsAround:
        """Return the points within ``radius`` metres of a place, as views of their cells; nothing is copied.

        `around` returns whole cells, which reach beyond the circle; `PointsAround.gather`, ``mask`` and
        ``count`` select the points within it.  `PointsAround.covered` is True if these are all points that
        the map has there.

        Parameters
        ----------
        x, y, radius
            Metres, map frame.
        layer
            Layers to return of each cell.
        z
            Only cells that reach into these heights, (lowest, highest), metres; points are not filtered by
            height.

        Other parameters and errors are those of `area`.
        """
        from shmmap.client.points_around import points_around  # only windows and few programs need it

        circle = geometry.Circle(x, y, radius, z)
        ask = partial(self._session.area, circle, names("layers", layer))

        def steps() -> Steps[PointsAround]:
            found = yield from self._answer(ask, circle, wait, strict)
            boxes = np.array([cell.box for cell in found]).reshape(-1, 4)
            return points_around(found.cells, boxes, x, y, radius, covered=found.complete)

        return self._run(steps())

    def differential(
        self,
        area: geometry.Area,
        held: Iterable[Held],
        layers: str | Sequence[str] = ("points",),
        *,
        wait: float | None = DEFAULT_WAIT_S,
        pose: Sequence[float] | None = None,
        velocity: Sequence[float] = (0.0, 0.0),
        heading: float | None = None,
        route: Sequence[tuple[float, float]] | NDArray[Any] = (),
        by_name: bool = False,
        populate: bool = False,
        timeout: float | None = None,
        strict: bool | None = False,
    ) -> CellSet:
        """Return the cells that touch an area, minus those that are held at their current version.

        Drop the cells that `CellSet.removed` lists before adding the new ones.  A cell whose version changed
        is returned, but not listed as removed.

        Parameters
        ----------
        held
            Cells of earlier answers; or ids, alone (meaning the current version), with a version ``(id,
            version)``, or also with the layers that have this version ``(id, version, layers)``.
        by_name
            Send held cells by name and version, not by version alone: for the first request to a
            restarted daemon, which cannot know what the versions of a previous run belonged to.
        populate
            Let the kernel map every page while attaching instead of at first touch.
        timeout
            Seconds the reply may take beyond ``wait``; None: the client's own timeout.

        Other parameters and errors are those of `area`.
        """
        specs, sent = names("layers", layers), given_intent(pose, velocity, heading, route)
        mine = HeldCells(held, by_name=by_name)
        ask = partial(
            self._session.differential, area, mine, specs, intent=sent, populate=populate, timeout_s=timeout
        )
        is_new = not mine.named and not mine.packed
        return self._run(self._answer(ask, area, wait, strict, new=is_new))

    def selected(
        self,
        ids: str | Iterable[str],
        layers: str | Sequence[str] = ("points",),
        *,
        wait: float | None = DEFAULT_WAIT_S,
        pose: Sequence[float] | None = None,
        velocity: Sequence[float] = (0.0, 0.0),
        heading: float | None = None,
        route: Sequence[tuple[float, float]] | NDArray[Any] = (),
        strict: bool | None = False,
    ) -> CellSet:
        """Return cells by id, in the requested order, with duplicates.

        An id is the absolute path of the cell's file, or its base name where that is unique.  Other
        parameters and errors are those of `area`.
        """
        specs, sent = names("layers", layers), given_intent(pose, velocity, heading, route)
        ask = partial(self._session.selected, names("ids", ids), specs, intent=sent)
        return self._run(self._answer(ask, None, wait, strict))

    @property
    def futures(self) -> Futures:
        """The requests for cells as `concurrent.futures.Future` objects: ``client.futures.around(x, y)``."""
        return Futures(self)

    def _run(self, steps: Steps[R]) -> R:
        return self._session.run(steps)

    def _answer(
        self,
        ask: Callable[[float | None], Steps[CellSet]],
        area: geometry.Area | None,
        wait: float | None,
        strict: bool | None,
        *,
        new: bool = True,
    ) -> Steps[CellSet]:
        """Repeat a request while cells are pending and ``wait`` is not over; return the last answer.

        Unless ``strict`` is None, warn or raise if it is incomplete.  If not all is ``new``, it may be empty.
        """
        found = CellSet()
        for wait_s in request_waits(wait):
            found = yield from ask(wait_s)
            if not found.pending:
                break
        has_points = any(cell.points for cell in found.cells)
        if strict is not None and (not found.complete or (new and not has_points)):
            from shmmap.lacking import verdict

            self._judge(partial(verdict, self, found, area, waited=bool(wait), strict=strict, new=new))
        return found

    def _judge(self, verdict: Callable[[], str]) -> None:
        """Warn of an answer that is incomplete; to find the words more may be asked."""
        if text := verdict():
            warn_program(text)

    def release(self) -> int:
        """Report the versions that this process dropped since the last request; return how many.

        Every request reports them, too; this is for programs that drop cells and then send no request.
        """
        return self._session.report_unmapped()

    # --- live maps ------------------------------------------------------------------------------

    def live(self, name: str, *, frame_id: str = "") -> LiveMap:
        """Return a live map, which other programs may write while it is read.

        Parameters
        ----------
        name
            Name of the map in the daemon.
        frame_id
            Frame in which this program works; empty: the map's own frame.

        Raises
        ------
        BadRequest
            There is no such map, or it has another frame.
        """
        from shmmap.client.live.live_map import LiveMap  # most clients use no live map

        return LiveMap(self._session, name, frame_id)

    def live_maps(self) -> tuple[LiveMapRow, ...]:
        """Return the live maps that the daemon keeps, with their state."""
        from shmmap.protocol.live import LiveList, LiveListed

        return until_served(lambda: self._session.ask(LiveList, LiveListed).maps, self.timeout)

    # --- the map ------------------------------------------------------------------------------------

    def metadata(
        self, area: geometry.Area | None = None, *, since: int | None = None, most: int | None = None
    ) -> MapListing:
        """List the map's cells, loaded or not.  A hundred thousand cells take half a second.

        Parameters
        ----------
        area
            Only cells that touch it.
        since
            Only what changed after this map version, if the daemon still knows it
            (`MapListing.since_known`).
        most
            Stop once more than this many cells are listed: the listing then has only the first cells.
        """
        from shmmap.client.map_listing import list_cells  # most clients never list cells

        return list_cells(self._session, area, since, most=most)

    # --- the daemon, for operators ----------------------------------------------------------------

    def stats(self) -> messages.StatsReply:
        """Return the daemon's counters, its sessions, and memory that processes without a session use."""
        return self._session.ask(messages.Stats, messages.StatsReply)

    def list_cells(self) -> list[messages.CellRow]:
        """List what is in memory, one row for each layer of a cell, by id, layer and version.

        Ids and names of segments lack the prefixes that `welcome` has, and ``holders`` is empty.  A hundred
        thousand segments take a second.
        """
        from shmmap.client.map_listing import list_segments  # most clients never list cells

        return list_segments(self._session)

    def show(self, cell: str) -> messages.ShownCell:
        """Return everything about one cell: versions, segments and which processes use them, last failure.

        Raises
        ------
        UnknownCell
            The map has no such cell.
        """
        return self._session.ask(lambda n: messages.Show(n, cell), messages.ShownCell)

    def reload(self) -> messages.Reloaded:
        """Make the daemon read the map's directory again.

        That may take a minute longer than other requests, plus a minute per million cells: the daemon checks
        all files.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        """
        most_s = RELOAD_S + RELOAD_CELL_S * self._session.welcome.cells
        return self._session.ask(messages.Reload, messages.Reloaded, quiet_s=most_s)

    def evict(self, ids: str | Iterable[str] | None = None) -> messages.Evicted:
        """Make the daemon drop cells, all by default; those in use are freed when they are released.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        """
        wanted = names("ids", ids) if ids is not None else None
        return self._session.ask(lambda n: messages.Evict(n, wanted), messages.Evicted)

    def pin(
        self, ids: str | Iterable[str] = (), layers: str | Sequence[str] = ("points",)
    ) -> messages.Pinned:
        """Make the daemon keep cells in memory, until `unpin` or its end; without ids, list its pins.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        OverBudget
            All pins together would exceed the budget.
        """
        wanted, specs = names("ids", ids), names("layers", layers)
        return self._session.ask(lambda n: messages.Pin(n, wanted, specs), messages.Pinned)

    def unpin(self, ids: str | Iterable[str] | None = None) -> messages.Pinned:
        """Stop the daemon from keeping cells, all by default; returns what stays pinned.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        """
        wanted = names("ids", ids) if ids is not None else None
        return self._session.ask(lambda n: messages.Unpin(n, wanted), messages.Pinned)

    def shutdown(self) -> None:
        """End the daemon, as SIGTERM would; mapped cells stay readable.

        Raises
        ------
        NotPermitted
            The daemon lets only administrators do this.
        """
        self._session.ask(messages.Shutdown, messages.Stopping)


class Deferred(Client):
    """A client whose requests are not sent, but returned as steps."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def _run(self, steps: Steps[R]) -> R:
        return steps  # type: ignore[return-value]


def _later(method: Callable[Concatenate[Client, P], R]) -> Callable[Concatenate[Futures, P], Future[R]]:
    """Return the method of `Futures` for a method of `Client`."""

    @wraps(method)
    def later(self: Futures, /, *args: P.args, **options: P.kwargs) -> Future[R]:
        from shmmap.client.futures import begin  # it takes milliseconds; most clients wait for each answer

        steps: Any = method(self._client, *args, **options)
        return begin(self._client.session, steps)

    return later


class Futures:
    """Requests for cells of a client that return a `concurrent.futures.Future`; get it as `Client.futures`.

    The methods have the parameters of `Client`'s, and invalid ones raise at once.  Other errors, and warnings
    as errors, are raised by ``result()``.  Any number may be under way: a request begins without waiting for
    another one, and warm ones are answered while others wait for loads.  Of those that wait for loads the
    daemon keeps 64 of a session; others are asked again when one of them ends.

    ``cancel()`` succeeds until the answer is there, and ends the request's wait in the daemon.  Callbacks run
    in one thread for all clients of the process, in which cells are attached, too: let them be short.  After
    a fork the futures of the parent that were under way raise `BadRequest` in the child.  `Client.close` ends
    those that are under way with `BadRequest`.
    """

    def __init__(self, client: Client) -> None:
        self._client = Deferred(client.session)

    around = _later(Client.around)
    area = _later(Client.area)
    points_around = _later(Client.points_around)
    differential = _later(Client.differential)
    selected = _later(Client.selected)


def _load_all() -> None:
    """Import what a session may need later: an upgrade may replace the package's files under this program."""
    for name in (
        *("lacking", "mounts", "protocol.live"),
        *("client.handed_over", "client.map_listing", "client.points_around"),
    ):
        importlib.import_module(f"shmmap.{name}")
    know_names()
    remember_modules()


def connect(
    endpoint: str | os.PathLike[str] | None = None,
    *,
    instance: str | None = None,
    timeout: float = 5.0,
    connect_timeout: float = CONNECT_S,
    name: str = "",
    shm_dir: str | None = None,
) -> Client:
    """Find the daemon and begin a session.

    Parameters
    ----------
    endpoint
        The daemon's socket, a path or an ``ipc://`` URL; or an instance's name (a string without slash and
        point).  Without one: ``SHMMAP_ENDPOINT``, else the socket of the instance ``SHMMAP_INSTANCE``
        (``default``) in ``SHMMAP_RUNTIME_DIR``, or where that is not set in ``$XDG_RUNTIME_DIR/shmmap``,
        ``/tmp/shmmap-UID`` and ``/run/shmmap``, whichever answers first.
    instance
        Name of the daemon's instance, instead of an endpoint or ``SHMMAP_INSTANCE``.
    timeout
        Seconds a reply may take, in addition to the time that the request lets the daemon wait.
    connect_timeout
        Seconds until the daemon must have sent its `Welcome`.  If nothing listens, the error is immediate.
        The default is long, since programs wait for processors when a machine starts many at once.
    name
        Name of this program in ``shmmap clients``, at most 64 characters.  Empty: the name of its script, or
        of the module it was started as (``python -m``).
    shm_dir
        Directory of the segments as this process sees it (default: ``SHMMAP_SHM_DIR``, else as the daemon
        says); for containers that have it mounted elsewhere.

    Raises
    ------
    NoSocket, SocketPermission, StaleSocket, NoAnswer
        Why no daemon can be reached; all of them are `DaemonUnreachable`.
    ProtocolMismatch
        The process that listens is no shmmap daemon, or a daemon of another major version.
    LimitReached
        This process may not have the descriptors or threads that are needed.
    BadRequest
        The endpoint cannot be a socket path, or another argument is invalid.
    """
    try:
        _load_all()
    except (OSError, ImportError) as error:
        if no_files_left(error) is None:
            raise
        # the connection needs more descriptors than a module, and its error says how many
    return Client(
        candidates(endpoint, instance=instance),
        timeout=timeout_s("timeout", timeout),
        connect_timeout=timeout_s("connect_timeout", connect_timeout),
        name=name,
        shm_dir=shm_dir or os.environ.get("SHMMAP_SHM_DIR", ""),
    )
