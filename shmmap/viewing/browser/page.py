# SPDX-License-Identifier: Apache-2.0
"""One browser's page: what it shows, sent piece by piece.

All nodes hang below one frame.  A client is followed by moving that frame, so that the client stays where the
eye turns around, and coordinates stay small however far from its origin a map lies.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.quantities import format_bytes
from shmmap.viewing.browser.cell_points import BLOCK_BYTES, POINT_BYTES, Block, Colours
from shmmap.viewing.browser.detail import LEAVES, Changes, Choice, Eye, pixel_angle
from shmmap.viewing.page import Follower

if TYPE_CHECKING:
    import viser

Place = tuple[float, float, float]

NO_CLIENT: Final = "no client"
MAX_PLACE_BYTES: Final = 27_000_000
"""Most bytes of points sent while the eye stays where it is."""

_POINTS: Final = 2.0  # millions on a page, at first
_MOVED: Final = 0.01  # of its distance to what it turns around: the eye has moved
_QUEUED: Final = 3  # messages that wait for the network
_RED: Final = (201, 42, 42)
_BLUE: Final = (36, 90, 168)
_MARKER_M: Final = 4.0
_ROOT: Final = "/map"
_CORNERS: Final = np.array([[(n >> axis) & 1 for axis in range(3)] for n in range(8)], np.float64)
_EDGES: Final = np.array([(a, a | 1 << axis) for axis in range(3) for a in range(8) if not a >> axis & 1])
_ARROW: Final = np.array(
    [(1.0, 0, 0), (-0.7, 0.6, 0), (-0.4, 0, 0), (-0.7, -0.6, 0), (-0.4, 0, 0.5)], np.float32
)
_ARROW_FACES: Final = np.array([(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (0, 2, 1), (0, 3, 2)], np.uint32)


@dataclass
class Shown:
    """A cell on the page: its level, its version in the map's list, its number of points, and its nodes.

    ``is_whole`` is false for a substitute, to be asked for again.
    """

    level: int
    version: int
    points: int
    nodes: list[Any]
    is_whole: bool = True


@dataclass
class _Mark:
    """A client's nodes, and what they show."""

    looks: tuple[Any, ...]
    nodes: list[Any] = field(default_factory=list)


class Page:
    """A browser's page.

    Parameters
    ----------
    browser
        Its connection.
    start
        Where its scene has its origin at first, metres, map frame.
    follow
        Name of the client that is followed at first; `NO_CLIENT`.

    Attributes
    ----------
    shown
        Cells on the page, by their number in the map's list.
    choice
        What is to be seen; None before the first look.
    retry_s
        By cell: when it may be asked for again.
    sent_bytes, place_bytes
        Bytes of points sent in all, and since the eye moved.
    """

    def __init__(self, browser: viser.ClientHandle, start: Place, follow: str, title: str) -> None:
        self.browser = browser
        self.shown: dict[int, Shown] = {}
        self.choice: Choice | None = None
        self.retry_s: dict[int, float] = {}
        self.sent_bytes = self.place_bytes = 0
        self.points = 0
        self._origin = start
        self._eye = Eye(math.inf, 0.0, 0.0)
        self._root = browser.scene.add_frame(_ROOT, show_axes=False, position=_negative(start))
        self._marks: dict[str, _Mark] = {}
        self._lines: dict[Any, Any] = {}
        gui = browser.gui
        self._title = title
        self._status = gui.add_markdown("")
        self._legend = gui.add_html("")
        self._names: tuple[str, ...] = (follow,) if follow != NO_CLIENT else ()
        self._follow = gui.add_dropdown("Follow", (NO_CLIENT, *self._names), initial_value=follow)
        self._millions = gui.add_slider("Million points", 0.2, 3.0, 0.1, _POINTS)
        self._texts = ("", "")
        self._serials = (
            itertools.count()
        )  # a name is used once: what replaces a node is added before it is removed

    # --- the eye --------------------------------------------------------------------------------

    @property
    def most_points(self) -> float:
        """Points that the page may have."""
        return float(self._millions.value) * 1e6

    @property
    def followed(self) -> str:
        """Name of the client that is followed, or `NO_CLIENT`."""
        return str(self._follow.value)

    def eye(self) -> Eye:
        """Return where one looks from; the same object as before unless it has moved."""
        camera, old = self.browser.camera, self._eye
        at = camera.position + np.array(self._origin)
        x, y, z = at.tolist()
        pixel = pixel_angle(camera.fov, camera.image_height)
        reach = max(float(np.linalg.norm(camera.look_at - camera.position)), 1.0)
        moved = math.dist((x, y, z), (old.x, old.y, old.z)) > _MOVED * reach
        if moved or not 0.8 < pixel / old.pixel < 1.25:
            self._eye = Eye(x, y, z, pixel)
            self.place_bytes = 0
        return self._eye

    def go_to(self, place: Place) -> None:
        """Move the scene's origin: what is there is what the eye turns around."""
        if place != self._origin:
            self._origin = place
            with self.browser.atomic():
                _put_at(self._root, _negative(place))

    def is_busy(self) -> bool:
        """Whether messages wait for the network: more would only wait, too."""
        waiting = self.browser._websock_connection.get_message_buffer().message_from_id
        return len(waiting) > _QUEUED

    # --- cells ----------------------------------------------------------------------------------

    def drop(self, cells: Iterable[int]) -> None:
        """Remove cells."""
        for cell in cells:
            shown = self.shown.pop(cell)
            self.points -= shown.points
            for node in shown.nodes:
                node.remove()

    def repaint(self) -> None:
        """Have all cells sent again: colours mean something else now."""
        for shown in self.shown.values():
            shown.is_whole = False

    def put(
        self, cell: int, level: int, version: int, parts: Iterable[Block], *, is_whole: bool = True
    ) -> None:
        """Show a cell, instead of what it was shown as."""
        nodes, points, serial = [], 0, next(self._serials)
        with self.browser.atomic():
            for number, part in enumerate(parts):
                nodes.append(
                    self.browser.scene.add_point_cloud(
                        f"{_ROOT}/cells/{cell}.{serial}.{number}",
                        part.points,
                        part.colours,
                        point_size=LEAVES[level],
                        point_shading="flat",
                        precision="float16",
                        position=part.centre,
                    )
                )
                points += len(part.points)
            if cell in self.shown:
                self.drop((cell,))
        nbytes = points * POINT_BYTES + len(nodes) * BLOCK_BYTES
        self.sent_bytes += nbytes
        self.place_bytes += nbytes
        self.points += points
        self.shown[cell] = Shown(level, version, points, nodes, is_whole)

    def due(self, changes: Changes, now_s: float) -> list[tuple[int, int]]:
        """Return the cells to ask for next: the nearest, and others of its level."""
        if self.place_bytes >= MAX_PLACE_BYTES:
            return []
        wanted = [one for one in changes.wanted if self.retry_s.get(one[0], 0.0) <= now_s]
        return [one for one in wanted[:64] if one[1] == wanted[0][1]]

    def as_shown(self) -> dict[int, tuple[int, int]]:
        """Return the level and version of each cell on the page, without substitutes that are due again."""
        now_s = time.monotonic()
        return {
            cell: (one.level, one.version)
            for cell, one in self.shown.items()
            if one.is_whole or self.retry_s.get(cell, 0.0) > now_s
        }

    # --- clients, windows, chunks ---------------------------------------------------------------

    def mark(self, clients: Sequence[tuple[Follower, float]]) -> None:
        """Draw clients and their windows; each with the height of the ground there."""
        found = {client.name: (client, ground) for client, ground in clients}
        for name in self._marks.keys() - found.keys():
            self._unmark(name)
        for name, (client, ground) in found.items():
            shape = (client.heading is None, client.box is None, client.is_round)
            old = self._marks.get(name)
            if old is not None and old.looks[0] != shape:
                self._unmark(name)
                old = None
            place = (client.x, client.y, ground)
            looks = (shape, place, client.heading, client.box)
            if old is None:
                self._marks[name] = _Mark(
                    looks, self._nodes(f"{_ROOT}/clients/{next(self._serials)}", client, place)
                )
            elif old.looks != looks:
                old.looks = looks
                with self.browser.atomic():
                    self._move(old, client, place)
        names = tuple(sorted(found.keys() - {NO_CLIENT}))  # a list with one text twice is shown by no browser
        if names != self._names:
            self._names = names
            kept = () if self.followed == NO_CLIENT or self.followed in names else (self.followed,)
            self._follow.options = (NO_CLIENT, *names, *kept)

    def _unmark(self, name: str) -> None:
        for node in self._marks.pop(name).nodes:
            node.remove()

    def _nodes(self, path: str, client: Follower, place: Place) -> list[Any]:
        scene, at = self.browser.scene, (place[0], place[1], place[2] + 1.0)
        if client.heading is None:
            marker: Any = scene.add_icosphere(f"{path}.at", radius=_MARKER_M / 2, color=_RED, position=at)
        else:
            marker = scene.add_mesh_simple(
                f"{path}.at",
                _ARROW * _MARKER_M,
                _ARROW_FACES,
                color=_RED,
                side="double",
                flat_shading=True,
                wxyz=_turn(client.heading),
                position=at,
            )
        nodes = [marker, scene.add_label(f"{path}.name", client.name, position=at)]
        if client.box is not None:
            centre = _centre(client.box)
            nodes.append(
                scene.add_line_segments(
                    f"{path}.window",
                    _ring(client.box, is_round=client.is_round),
                    _RED,
                    thickness=2.0,
                    thickness_units="screen",
                    position=(*centre, place[2] + 0.5),
                )
            )
        return nodes

    def _move(self, mark: _Mark, client: Follower, place: Place) -> None:
        at = (place[0], place[1], place[2] + 1.0)
        for node in mark.nodes[:2]:
            _put_at(node, at)
        if client.heading is not None:
            mark.nodes[0].wxyz = _turn(client.heading)
        if client.box is not None:
            _put_at(mark.nodes[2], (*_centre(client.box), place[2] + 0.5))
            ring = _ring(client.box, is_round=client.is_round)
            if not np.array_equal(mark.nodes[2].points, ring):
                mark.nodes[2].points = ring

    def outline(self, boxes: dict[Any, tuple[float, float, float, float, float, float]]) -> None:
        """Draw boxes: min_x, min_y, min_z, max_x, max_y, max_z, metres, by a key each."""
        for key in self._lines.keys() - boxes.keys():
            self._lines.pop(key).remove()
        for key in boxes.keys() - self._lines.keys():
            low, high = np.array(boxes[key][:3]), np.array(boxes[key][3:])
            corners = (_CORNERS * (high - low)).astype(np.float32)
            self._lines[key] = self.browser.scene.add_line_segments(
                f"{_ROOT}/chunks/{key[0]}/{'_'.join(map(str, key[1]))}",
                corners[_EDGES],
                _BLUE,
                thickness=1.0,
                thickness_units="screen",
                position=(low[0], low[1], low[2]),
            )

    # --- texts ----------------------------------------------------------------------------------

    def say(self, problem: str, colours: Colours, meaning: str, waiting: int) -> None:
        """Update the texts beside the scene."""
        lines = [
            f"**{_plain(self._title)}**",
            f"{self.points:,} points of {len(self.shown):,} cells"
            + (f", {waiting:,} to come" if waiting else ""),
            f"{format_bytes(self.sent_bytes)} sent",
        ]
        status = "  \n".join([*lines, f"*{_plain(problem)}*"] if problem else lines)
        stops = ",".join(f"rgb{stop}" for stop in colours.ramp.stops)
        legend = (
            f'<div style="margin:0 1em;font-size:0.8em">{meaning}<div style="height:0.8em;'
            f'background:linear-gradient(90deg,{stops})"></div>{colours.low:.3g} - {colours.high:.3g}</div>'
            if colours.low < colours.high
            else ""
        )
        if status != self._texts[0]:
            self._status.content = status
        if legend != self._texts[1]:
            self._legend.content = legend
        self._texts = status, legend


def _plain(text: str) -> str:
    """Return Markdown that shows just this text: paths and messages of errors may look like HTML."""
    return "".join(one if one.isalnum() or one in " ,;" else f"&#{ord(one)};" for one in text)


def _negative(place: Place) -> Place:
    return -place[0], -place[1], -place[2]


def _put_at(node: Any, place: Place) -> None:
    """Move a node.

    By way of 0: viser takes a step below 1e-5 of the coordinates, 50 m in UTM, for none.
    """
    node.position = (0.0, 0.0, 0.0)
    node.position = place


def _turn(heading: float) -> tuple[float, float, float, float]:
    return math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)


def _centre(box: Sequence[float]) -> tuple[float, float]:
    return (box[0] + box[2]) / 2, (box[1] + box[3]) / 2


def _ring(box: Sequence[float], *, is_round: bool) -> NDArray[np.float32]:
    """Return the border of a window about its centre as segments, (N, 2, 3)."""
    half_x, half_y = (box[2] - box[0]) / 2, (box[3] - box[1]) / 2
    if is_round:
        turns = np.linspace(0.0, 2 * np.pi, 73)
        corners = np.stack([half_x * np.cos(turns), half_y * np.sin(turns)], axis=1)
    else:
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * (half_x, half_y)
    flat = np.column_stack([corners, np.zeros(len(corners))]).astype(np.float32)
    return np.stack([flat[:-1], flat[1:]], axis=1)
