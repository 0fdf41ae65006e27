# SPDX-License-Identifier: Apache-2.0
"""``shmmap view``: draw points of a map or of files into a picture, or show the daemon's map in a browser."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from shmmap.cli.areas import add_area_options, area_from
from shmmap.cli.daemon_address import connect
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb, numbers, seconds
from shmmap.cli.program import add_allow_empty, complain, nothing_found, output_file
from shmmap.cli.screens.output import counted, print_json, print_line
from shmmap.cli.verbs.maps.map_options import add_store_options, add_trust_option, store_at, verified_at
from shmmap.errors import BadRequest
from shmmap.lacking import area_text, extent_text

if TYPE_CHECKING:
    from shmmap.protocol.rows import ClientRow
    from shmmap.viewing.page import Drawn, Follower, View
    from shmmap.viewing.sources import BoxTuple, PointSource

_FROM: Final = (
    "above",
    "north",
    "north-east",
    "east",
    "south-east",
    "south",
    "south-west",
    "west",
    "north-west",
    "behind",
)
_MAX_PIXELS: Final = 1 << 26
_AROUND_CLIENT_M: Final = 60.0
_BESIDE_WINDOW: Final = 0.025  # of its side
_PORT: Final = 8765

_EXIT = """\
--browser prints the page's address, whose secret part keeps others out, and ends with Ctrl-C.  From another
machine: ssh -L 8765:127.0.0.1:8765 VEHICLE, then open the address there.
Exit code: 0; 1 when there is nothing to draw there (then nothing is written) or a cell could not be loaded
(the others are drawn), 2 wrong usage or no such column, 65 a damaged file, 66 no such file or map,
73 the picture cannot be written, 75 another program listens at the address of --listen."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``view``."""
    parser = add_verb(
        subparsers,
        "view",
        run,
        help="draw points into a picture, or turn them in a browser",
        description="Draw points from above or obliquely into a PNG picture with coordinates, scale bar and "
        "legend; no display is needed.  Without PATH, the points are the daemon's, which loads what is not "
        "in memory.\n"
        "PATH: any clouds that `inspect` reads, a divided map, a published map (or its URL), or the "
        "directory of a live map.\n"
        "Without an area the whole map is drawn.  Colours mean the height above the ground, unless --by "
        "names something else.\n"
        "With --browser, the daemon's map is shown live: points in the detail that the distance needs, "
        "clients, what they follow, and chunks of live maps.  What it shows is loaded only into memory that "
        "is free, while the daemon has nothing else to load.",
        output="look.outputs.Viewed",
        epilog=_EXIT,
    )
    parser.add_argument("paths", metavar="PATH", nargs="*", help="files to draw instead of a daemon's map")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--image", metavar="FILE.png", help="the picture to write")
    what.add_argument(
        "--browser",
        action="store_true",
        help="show the daemon's map in a browser until Ctrl-C (extra `view`)",
    )
    parser.add_argument(
        "--listen",
        metavar="ADDRESS",
        help="with --browser: a port of 127.0.0.1, or HOST:PORT, which others may reach (default: 8765, or "
        "a free one)",
    )
    add_area_options(parser, parser.add_mutually_exclusive_group(), heights=False)
    parser.add_argument(
        "--follow", metavar="CLIENT", help="what a client has around it; by its name, or its process id"
    )
    parser.add_argument(
        "--z",
        dest="heights",
        metavar="MIN,MAX",
        type=lambda text: numbers(text, "MIN,MAX"),
        help="only points between these heights, metres; a tunnel without the hill above it",
    )
    parser.add_argument(
        "--by",
        metavar="COLUMN",
        default="height",
        help="what the colours mean: height (above the ground, the default), z, or a column such as "
        "intensity; normal[2] is the third value of a wide column",
    )
    parser.add_argument("--layer", metavar="SPEC", help="the layer to draw instead of points; from a daemon")
    parser.add_argument(
        "--from",
        dest="direction",
        metavar="SIDE",
        choices=_FROM,
        default="above",
        help="where one looks from: above (the default), north, north-east, east, ...; behind: the client "
        "that --follow names",
    )
    parser.add_argument(
        "--size", metavar="WxH", type=_size, default=(1280, 800), help="size in pixels (default: 1280x800)"
    )
    parser.add_argument(
        "--wait", metavar="SECONDS", type=seconds, default=60.0, help="how long loads may take (default: 60)"
    )
    add_allow_empty(parser)
    add_trust_option(parser)
    add_store_options(parser)
    add_daemon_options(parser)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    width, height = map(int, found.groups()) if found else (0, 0)
    if width < 480 or height < 320 or width * height > _MAX_PIXELS:
        raise argparse.ArgumentTypeError(f"expected a size such as 1280x800, 480x320 or more, not {text!r}")
    return width, height


def run(args: argparse.Namespace) -> int:
    """Draw the picture, and write it; or serve the page."""
    _check(args)
    if args.browser:
        return _serve(args)
    area = area_from(args)
    path = output_file(args.image)
    with _opened(args) as (source, follower, close_to):
        everywhere = source.extent()
        box = close_to or (area.bounds if area is not None else everywhere)
        if box is not None and box == everywhere:
            box = _widened(box)
        if box is None:
            return nothing_found(args, f"{source.title}: there is no point")
        view = _view(args, box, follower)
        from shmmap.viewing.page import draw

        drawn = draw(source, view)
        problems = list(source.problems)
        if drawn is None:
            _complain_of(problems)
            where = area_text(area) if area is not None else f"in {extent_text(box)}"
            spans = f"; the {'map' if not args.paths else 'points'} span{'s' if not args.paths else ''}"
            return nothing_found(
                args, f"no point {where}{f'{spans} {extent_text(everywhere)}' if everywhere else ''}"
            )
    nbytes = _write(path, drawn)
    if args.json:
        from shmmap.cli.verbs.look import outputs

        print_json(
            outputs.Viewed(
                os.path.abspath(path),
                view.size[0],
                view.size[1],
                nbytes,
                drawn.points,
                drawn.parts,
                list(drawn.box),
                drawn.metres_per_pixel,
                args.by,
                drawn.low,
                drawn.high,
            )
        )
    else:
        shown = f"{counted(drawn.points, 'point')} of {counted(drawn.parts, source.what)}"
        print_line(f"wrote {path}: {shown}, {extent_text(_rounded(drawn.box))}")
    _complain_of(problems)
    return 1 if problems else 0


def _check(args: argparse.Namespace) -> None:
    """Refuse options that do not go together, and a picture of another format."""
    if args.follow is not None and area_from(args) is not None:
        raise BadRequest("--follow has an area of its own", hint="leave out the other area")
    if args.browser:
        for option in ("paths", "layer", "heights"):
            if getattr(args, option):
                name = {"paths": "PATH", "layer": "--layer", "heights": "--z"}[option]
                raise BadRequest(f"--browser shows a daemon's map, without {name}", hint="or use --image")
        if args.direction != "above":
            raise BadRequest("--from is for a picture: a browser's view is turned there", hint="leave it out")
        if args.json:
            raise BadRequest(
                "--json describes a picture", hint="leave it out: --browser prints one line, its address"
            )
    elif args.listen is not None:
        raise BadRequest("--listen goes with --browser")
    if args.browser:
        return
    if os.path.splitext(args.image)[1].lower() != ".png":
        raise BadRequest(f"{args.image}: pictures are PNG files", hint="name it .png")
    if args.direction == "behind" and args.follow is None:
        raise BadRequest("--from behind goes with --follow", hint="--follow CLIENT says behind whom")
    if args.paths:
        for option in ("follow", "layer"):
            if getattr(args, option) is not None:
                raise BadRequest(
                    f"--{option} is for a daemon's map, not for files",
                    hint="leave out the files, or the option",
                )


def _serve(args: argparse.Namespace) -> int:
    """Show the daemon's map to browsers until a signal."""
    from shmmap.cli.listening import listen_address, listening_at
    from shmmap.viewing.browser.door import Door, open_server
    from shmmap.viewing.browser.live_view import LiveView

    area = area_from(args)
    host, port = listen_address(args.listen or str(_PORT))
    with (
        connect(args, "shmmap view") as client,
        listening_at(host, port, is_fixed=args.listen is not None) as listening,
    ):
        if args.follow is not None:
            args.follow = _client(client.stats().sessions, args.follow).name
        door = Door(host)
        server = open_server(listening, door, "shmmap")
        try:
            view = LiveView(
                client, server, by=args.by, follow=args.follow, area=None if area is None else area.bounds
            )
            print_line(f"open {door.url(listening)}", flush=True)
            view.run()
        except KeyboardInterrupt:
            return 0
        finally:
            server.stop()
    return 0


@contextlib.contextmanager
def _opened(
    args: argparse.Namespace,
) -> Iterator[tuple[PointSource, Follower | None, BoxTuple | None]]:
    """Open the source of the points; with ``--follow`` also the client, and the area around it."""
    if args.paths:
        from shmmap.origin.remote.store import is_published

        if len(args.paths) == 1 and is_published(args.paths[0]):
            from shmmap.viewing.sources import published_points

            store = store_at(args.paths[0], args)
            verified = verified_at(store, args)
            yield published_points(store, verified.current if verified is not None else None), None, None
            return
        from shmmap.viewing.sources import open_files

        with open_files(args.paths) as files:
            yield files, None, None
        return
    from shmmap.viewing.sources import served_points

    with connect(args, "shmmap view") as client:
        follower, box = None, None
        if args.follow is not None:
            follower = _client(client.stats().sessions, args.follow)
            box = _around(follower)
        yield served_points(client, args.layer or "points", args.wait), follower, box


def _around(follower: Follower) -> BoxTuple:
    """Return the area that a client follows, and a little beside it."""
    if follower.box is None:
        x, y, reach = follower.x, follower.y, _AROUND_CLIENT_M
        return x - reach, y - reach, x + reach, y + reach
    min_x, min_y, max_x, max_y = follower.box
    more_x, more_y = _BESIDE_WINDOW * (max_x - min_x), _BESIDE_WINDOW * (max_y - min_y)
    return min_x - more_x, min_y - more_y, max_x + more_x, max_y + more_y


def _client(clients: Sequence[ClientRow], wanted: str) -> Follower:
    """Return the client of a name or process id that asked last, among those that say where they are."""
    from shmmap.viewing.page import follower_of

    placed = [one for one in clients if one.pose is not None or one.window is not None]
    found = [one for one in clients if wanted in (one.client, one.command, str(one.pid))]
    those = [one for one in found if one in placed]
    if not those:
        names = ", ".join(dict.fromkeys(one.client or one.command or str(one.pid) for one in placed))
        there = f"clients that did: {names}" if names else "no client did"
        if found:
            raise BadRequest(f"client {wanted!r} has not said where it is", hint=f"{there}; or give --circle")
        raise BadRequest(
            f"no client is called {wanted!r}",
            hint=f"there are: {names}" if names else "no client has said where it is; give --circle",
        )
    found_one = follower_of(max(those, key=lambda row: row.last_request_monotonic_ns))
    assert found_one is not None  # noqa: S101  it is placed
    return found_one


def _view(args: argparse.Namespace, box: BoxTuple, follower: Follower | None) -> View:
    from shmmap.geometry import checked_heights
    from shmmap.viewing.page import View, looking_from

    azimuth: float | None = None
    if args.direction == "behind":
        if follower is None or follower.heading is None:
            raise BadRequest(f"client {args.follow!r} has no heading yet", hint="--from south")
        azimuth = follower.heading
    elif args.direction != "above":
        azimuth = looking_from(args.direction)
    return View(box, checked_heights(args.heights), azimuth, args.by, args.size, follower)


def _widened(box: BoxTuple) -> BoxTuple:
    """Return a box that shows its border, too."""
    margin = 0.01 * max(box[2] - box[0], box[3] - box[1])
    return box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin


def _rounded(box: BoxTuple) -> BoxTuple:
    return round(box[0], 1), round(box[1], 1), round(box[2], 1), round(box[3], 1)


def _write(path: os.PathLike[str], drawn: Drawn) -> int:
    """Write the picture, complete or not at all; return its size in bytes."""
    from shmmap.formats.durable_file import appearing_file, writing_errors
    from shmmap.formats.png import png_bytes

    data = png_bytes(drawn.pixels)
    with writing_errors(str(path)), appearing_file(path) as file:
        file.write(data)
    return len(data)


def _complain_of(problems: list[str]) -> None:
    for line in problems[:10]:
        complain("shmmap", line)
    if len(problems) > 10:
        complain("shmmap", f"and {len(problems) - 10:,} more")
