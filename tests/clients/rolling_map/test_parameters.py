# SPDX-License-Identifier: Apache-2.0
"""Rolling-Bonxai's parameter file, version 1, is read as it is; what it does not know is refused."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from shmmap_clients.rolling_map.parameters import (
    LiveSettings,
    Parameters,
    Shown,
    live_section,
    read_parameters,
)

from shmmap import BadRequest
from shmmap.errors import ConfigError, MapMissing
from shmmap.live import Occupancy, ScanFilter

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SHIPPED = """\
map_frame: "map"
sensor_frame: "zed_camera_link"
robot_frame: "zed_camera_link"

m_resolution: 0.05
m_occupancy_min_thresh: 0.12
m_occupancy_max_thresh: 0.97

s_max_z: 2.0
s_min_z: -2.0
s_max_range: 5.0
s_min_range: 0.5
s_probability_hit: 0.7
s_probability_miss: 0.4

c_chunk_dim: 64
c_chunk_folder_path: "/maps/chunks"

use_sor_filter: false

viz_occupied: true
viz_free: false
viz_chunks: true
viz_usage: false
"""

OTHER = """\
m_resolution: 1e-1   # PyYAML takes this for text
map_frame: odom
m_occupancy_min_thresh: 0.2
m_occupancy_max_thresh: 0.9
s_max_z: 3
s_min_z: -1.5
s_max_range: 30
s_min_range: 1
s_probability_hit: 0.8
s_probability_miss: 0.3
viz_occupied: off
viz_free: True
viz_chunks: false
viz_usage: yes
"""


@pytest.fixture
def read(tmp_path: Path) -> Any:
    def from_text(text: str) -> Parameters:
        path = tmp_path / "p.yaml"
        path.write_text(text, encoding="utf-8")
        return read_parameters(path)

    return from_text


def refused(read: Any, text: str) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        read(text)
    return caught.value


def test_the_shipped_file_says_what_is_the_default_here(read: Any) -> None:
    shipped = read(SHIPPED)
    assert shipped.live == LiveSettings(path="/maps/chunks")
    assert shipped.scan_filter == ScanFilter() == Parameters().scan_filter
    assert shipped.live.occupancy == Occupancy()
    assert shipped.shown == Shown(occupied=True, free=False, chunks=True, usage=False) == Shown()
    assert list(shipped.without_effect) == ["sensor_frame", "robot_frame"]
    assert read("") == Parameters() == read("# nothing\n")


def test_every_value_arrives(read: Any) -> None:
    other = read(OTHER)
    occupancy = Occupancy(hit=0.8, miss=0.3, clamp_min=0.2, clamp_max=0.9)
    assert other.live == LiveSettings(0.1, occupancy, "odom")
    assert other.scan_filter == ScanFilter(min_range=1.0, max_range=30.0, min_z=-1.5, max_z=3.0)
    assert other.shown == Shown(occupied=False, free=True, chunks=False, usage=True)
    assert other.warning == ""
    assert other.origins["s_max_range"].endswith("p.yaml:7")


@pytest.mark.parametrize("node", ["rolling_map_node", "/**", "/front/rolling_map_node"])
def test_names_may_stand_under_a_node(read: Any, node: str) -> None:
    inside = "".join(f"    {line}\n" for line in OTHER.splitlines())
    nested = read(f"{node}:\n  ros__parameters:\n{inside}")
    flat = read(OTHER)
    assert (nested.live, nested.scan_filter, nested.shown) == (flat.live, flat.scan_filter, flat.shown)


def test_one_warning_names_all_that_has_no_effect(read: Any) -> None:
    text = SHIPPED.replace("dim: 64", "dim: 32").replace("use_sor_filter: false", "use_sor_filter: true")
    found = read(text + "c_chunk_neiborhood: 6\nc_chunk_cache_capacity: 7\n")
    assert "\n" not in found.warning
    for name in (
        "sensor_frame",
        "robot_frame",
        "c_chunk_dim: 32",
        "use_sor_filter: true",
        "c_chunk_neiborhood",
        "c_chunk_cache_capacity",
    ):
        assert found.warning.count(name) == 1
    assert (found.live, found.scan_filter) == (LiveSettings(path="/maps/chunks"), ScanFilter())


def test_an_unknown_name_is_refused_with_the_nearest_and_its_line(read: Any) -> None:
    error = refused(read, "m_resolution: 0.1\n\ns_maxrange: 3.0\n")
    assert error.message.endswith("p.yaml:3: Rolling-Bonxai has no parameter s_maxrange")
    assert error.hint == "the nearest is s_max_range"
    assert (error.key, error.origin.rpartition(":")[2]) == ("s_maxrange", "3")
    assert refused(read, "q: 1").hint.startswith("the nearest is ")


VERSION_2 = """\
rolling_bonxai_server_node:
  ros__parameters:
    frame_id: "map"
    base_frame_id: "zed_camera_link"
    topic_in: "/zed/zed_node/point_cloud/cloud_registered"
    occupancy:
      resolution: 0.02
      occupancy_min_z: -100.0
    sensor_model:
      max_range: 10.0
      hit: 0.7
      min: 0.12
    rolling:
      coordinate_system:
        chunk_size: 5.0
      transition_manager:
        hysteresis_ratio: 0.2
      storage:
        full_save_folder_path: "/home/tmp/rolling_bonxai"
      asyncio:
        num_load_threads: 3
"""


def test_version_2_is_refused_with_the_names_of_version_1(read: Any) -> None:
    error = refused(read, VERSION_2)
    assert "p.yaml:3: frame_id is a name of Rolling-Bonxai's version 2" in error.message
    assert error.message.endswith("which version 1 calls map_frame")
    for same in (
        "m_resolution for occupancy.resolution",
        "s_min_z for occupancy.occupancy_min_z",
        "s_max_range for sensor_model.max_range",
        "s_probability_hit for sensor_model.hit",
        "m_occupancy_min_thresh for sensor_model.min",
        "c_chunk_dim for rolling.coordinate_system.chunk_size",
        "hysteresis in [live.NAME] of the daemon's settings for rolling.transition_manager.hysteresis_ratio",
        "c_chunk_folder_path for rolling.storage.full_save_folder_path",
        "nothing for rolling.asyncio.num_load_threads",
    ):
        assert same in error.hint
    mixed = refused(read, "m_resolution: 0.1\nsensor_model:\n  hit: 0.7\n")
    assert mixed.key == "sensor_model.hit"
    assert mixed.origin.endswith(":3")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("m_resolution: fine", "p.yaml:1: m_resolution: need a number, not fine"),
        ("m_resolution: '0.1'", "need a number, not 0.1"),
        ("m_resolution: true", "need a number, not true"),
        ("m_resolution:", "need a number, not a list or nothing"),
        ("m_resolution: [0.1]", "need a number, not a list or nothing"),
        ("m_resolution: 1_0", "need a number"),
        ("m_resolution: -1", "p.yaml:1: m_resolution = -1.0: need a positive number"),
        ("m_resolution: .nan", "m_resolution = nan: need a positive number"),
        ("m_resolution: .inf", "m_resolution = inf: need a positive number"),
        ("viz_free: 1", "viz_free: need true or false, not 1"),
        ("map_frame: 3", "map_frame: need text, not 3"),
        ("map_frame: ''", "map_frame = '': need 1 to 40 bytes"),
        (f"map_frame: {'m' * 41}", "need 1 to 40 bytes"),
        ('map_frame: "a\\nb"', "need 1 to 40 bytes of printable text"),
        ('map_frame: "\\ud800"', "need 1 to 40 bytes of printable text"),
        ("\n\ns_max_z: -3", "p.yaml:3: s_max_z = -3.0: need more than s_min_z = -2.0"),
        ("\ns_min_z: 3", "p.yaml:2: s_max_z = 2.0: need more than s_min_z = 3.0"),
        ("s_probability_hit: 0.3", "p.yaml:1: s_probability_hit = 0.3: need more than 0.0005 above 0.5"),
        ("m_occupancy_max_thresh: 1.0", "m_occupancy_max_thresh = 1.0: need a probability"),
        ("m_resolution: 0.1\nm_resolution: 0.2", "p.yaml:2: m_resolution again: it stands at .*p.yaml:1"),
        ("m_resolution: {", "p.yaml:1: no YAML|p.yaml:2: no YAML"),
        ("just words", "p.yaml: no parameters"),
        ("- 1", "p.yaml: no parameters"),
        ("[a, b]: 1", "p.yaml:1: a name must be one word"),
        ("a: &a 1\nm_resolution: *a", "p.yaml:2: aliases are not read"),
        ("a: &a\n  b: *a", "aliases are not read"),
        ("[" * 5000, "p.yaml:1: nested too deeply"),
        ("a:\n  ros__parameters: {}\nb:\n  ros__parameters: {}", "several nodes \\(a, b\\)"),
        ("a:\n  ros__parameters: {}\nm_resolution: 1", "p.yaml:3: m_resolution stands beside a node"),
        ("a:\n  ros__parameters: 3", "p.yaml:2: need lines such as"),
        ("\x00", "no YAML"),
        ("#" * (1 << 20) + "\n", "larger than a parameter file"),
    ],
)
def test_what_is_wrong_is_reported_with_its_place(read: Any, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        read(text)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MapMissing, match="there is no file"):
        read_parameters(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="directory"):
        read_parameters(tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"map_frame: \xff\n")
    with pytest.raises(ConfigError, match="no YAML"):
        read_parameters(tmp_path / "latin.yaml")


def test_the_section_equals_the_file(read: Any) -> None:
    live = read(OTHER + 'c_chunk_folder_path: "/maps/a \\"b\\" ö😀"\n').live
    section = tomllib.loads(live_section("lidar", live))
    assert section == {
        "live": {
            "lidar": {
                "resolution": 0.1,
                "frame_id": "odom",
                "hit": 0.8,
                "miss": 0.3,
                "clamp_min": 0.2,
                "clamp_max": 0.9,
                "occupied_above": 0.5,
                "free_below": 0.5,
                "radius": 1,
                "hysteresis": 0.0,
                "path": '/maps/a "b" ö😀',
            }
        }
    }
    assert "path" not in tomllib.loads(live_section("x", LiveSettings()))["live"]["x"], "the daemon chooses"


def test_a_relative_path_is_where_the_program_runs(
    read: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = read("c_chunk_folder_path: chunks\n").live
    monkeypatch.chdir(tmp_path)
    assert tomllib.loads(live_section("x", live))["live"]["x"]["path"] == str(tmp_path / "chunks")


@pytest.mark.parametrize("name", ["", "a b", "a.b", "ä", "a]\nx", "n" * 65])
def test_names_that_no_map_can_have(name: str) -> None:
    with pytest.raises(BadRequest, match="is no name of a map"):
        live_section(name, LiveSettings())
