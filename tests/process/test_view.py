# SPDX-License-Identifier: Apache-2.0
"""``shmmap view`` and ``map --svg`` against a real daemon: what is drawn, and what is refused."""

from __future__ import annotations

import base64
from pathlib import Path
from xml.etree import ElementTree

import pytest

import shmmap as library
from tests.support.command_line import Shmmap
from tests.support.divided_map import DividedMap
from tests.support.pictures import png_pixels


def points_in(standing_map: DividedMap, box: tuple[float, float, float, float]) -> int:
    """Points of the map's files that lie in a box."""
    found = 0
    for name in standing_map.corners:
        x, y = (standing_map.points(name)[axis].astype(float) for axis in "xy")
        found += int(((x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])).sum())
    return found


def test_the_whole_map_from_above(reading: Shmmap, standing_map: DividedMap) -> None:
    report = reading.json("view", "--image", "map.png", "--size", "640x480")
    picture = png_pixels((reading.cwd / "map.png").read_bytes(), "RGB")
    assert picture.shape == (480, 640, 3)
    assert report["image"] == str(reading.cwd / "map.png")
    assert (report["width"], report["height"], report["by"]) == (640, 480, "height")
    assert report["bytes"] == (reading.cwd / "map.png").stat().st_size
    assert report["parts"] == len(standing_map.corners)
    everything = sum(len(standing_map.points(name)["x"]) for name in standing_map.corners)
    assert report["points"] == everything
    assert reading("view", "--image", "again.png").startswith(f"wrote again.png: {everything:,} points of")


def test_an_area_is_drawn_whole_and_colours_are_those_of_the_column(
    reading: Shmmap, standing_map: DividedMap
) -> None:
    words = ("view", "--box=-15,-5,5,10", "--image", "area.png", "--by", "intensity")
    report = reading.json(*words)
    assert report["box"][0] <= -15 < 5 <= report["box"][2]
    assert report["points"] == points_in(standing_map, tuple(report["box"]))
    assert report["low"] < report["high"]
    oblique = reading.json(*words, "--from", "south-west")
    assert oblique["box"] == [-15, -5, 5, 10]
    assert oblique["points"] == points_in(standing_map, (-15, -5, 5, 10))


def test_a_client_is_followed(reading: Shmmap) -> None:
    with library.connect(reading.daemon.endpoint, name="planner", shm_dir=reading.daemon.shm_dir) as client:
        window = library.MapWindow(client, radius=12)
        window.move_to(3.0, 4.0, heading=0.5)
        report = reading.json("view", "--follow", "planner", "--image", "f.png", "--from", "behind")
        assert report["box"] == pytest.approx([3 - 12.6, 4 - 12.6, 3 + 12.6, 4 + 12.6])
        pixels = png_pixels((reading.cwd / "f.png").read_bytes(), "RGB").astype(int)
        assert ((pixels == (201, 42, 42)).all(axis=2)).sum() > 40, "the vehicle"
        refused = reading.run("view", "--follow", "stranger", "--image", "g.png")
        assert (refused.returncode, "planner" in refused.stderr) == (2, True)
    assert not (reading.cwd / "g.png").exists()


def test_layers(reading: Shmmap, standing_map: DividedMap) -> None:
    del standing_map
    for layer, by in (
        ("voxel(leaf=0.5)", "count"),
        ("elevation(resolution=1.0)", "max"),
        ("ndt(leaf=2.0)", "z"),
    ):
        report = reading.json("view", "--layer", layer, "--by", by, "--image", "l.png", "--circle", "0,0,15")
        assert report["points"] > 0
    refused = reading.run("view", "--layer", "ndt(leaf=2.0)", "--by", "table", "--image", "no.png")
    assert refused.returncode == 2
    assert "column 'table' has no value for each of its" in refused.stderr


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("--image map.jpg", 2, "hint: name it .png"),
        ("--image m.png --by ring", 2, "has no column 'ring'\nhint: it has xyz,"),
        ("--image m.png --by intensity[3]", 2, "has 1 value a point"),
        ("--image m.png --circle 5000,5000,10", 1, "no point within 10 m of (5000, 5000); the map spans x"),
        ("--image m.png --z 900,901", 1, "no point in x"),
        ("--image m.png --from behind", 2, "--from behind goes with --follow"),
        ("--image nowhere/m.png", 73, "cannot write nowhere/m.png"),
        ("--image m.png --size 100x100", 2, "480x320 or more"),
        ("--image m.png gone.pcd", 66, "gone.pcd: No such file"),
        ("--image m.png gone.pcd --layer ndt", 2, "--layer is for a daemon's map, not for files"),
        ("--image m.png gone.pcd --follow planner", 2, "--follow is for a daemon's map, not for files"),
        ("", 2, "one of the arguments --image --browser is required"),
    ],
)
def test_what_is_refused(reading: Shmmap, words: str, code: int, said: str) -> None:
    done = reading.run("view", *words.split())
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert not list(reading.cwd.glob("*.png")), "nothing is written"


def test_nothing_found_may_be_allowed(reading: Shmmap) -> None:
    reading("view", "--image", "m.png", "--circle", "5000,5000,10", "--allow-empty")
    assert not list(reading.cwd.glob("*"))


def test_the_map_has_coordinates_names_and_points(reading: Shmmap, standing_map: DividedMap) -> None:
    reading("query", "--box=-100,-100,100,100", "--wait", "20", "--allow-empty")
    reading("map", "--svg", "map.svg")
    picture = ElementTree.parse(reading.cwd / "map.svg").getroot()
    texts = [text.text or "" for text in picture.iter("{http://www.w3.org/2000/svg}text")]
    assert "0" in texts
    assert {Path(name).stem for name in standing_map.corners} <= {*texts} or len(standing_map.corners) > 60
    (image,) = picture.iter("{http://www.w3.org/2000/svg}image")
    pixels = png_pixels(base64.b64decode(image.attrib["href"].partition(",")[2]), "RGBA")
    assert 0.0 < (pixels[..., 3] > 0).mean() <= 1.0
