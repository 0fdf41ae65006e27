# SPDX-License-Identifier: Apache-2.0
"""Whole daemons that serve published maps to ordinary clients, beside one that serves the map's files."""

from __future__ import annotations

import itertools
import json
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.command_line import health, make_older, publish, verb
from tests.support.compiled_programs import built_preload, made_once
from tests.support.cpp_client import CppClient
from tests.support.daemon_process import Deadline, counters
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.forked_programs import run_verb
from tests.support.map_stores import KEYS, BucketServer
from tests.support.published_daemon import (
    ALL,
    all_cells,
    until,
    until_asked,
    until_health,
    until_taken,
    versions_of,
    without,
)
from tests.support.raw_client import DaemonError, RawClient, circle
from tests.support.segment_reader import names
from tests.support.skips import open3d_or_skip
from tests.support.web_servers import FaultyWeb, faulty_web

pytest.importorskip("zstandard", reason="zstandard is not installed")
pytest.importorskip("obstore", reason="obstore is not installed")

NDT = "ndt(leaf=2.0,min_points=3)"
PUBLISHED = ("points", NDT)
COMPUTED = ("voxel(leaf=1.0)", "normals(radius=2.0)")
"""Of one cell alone, and of the cells around it, too."""

Connect = Callable[..., RawClient]


@pytest.fixture(scope="session")
def _published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once(tmp_path_factory, "served", _publish_town)


def _publish_town(folder: Path) -> None:
    made = make_map(folder / "town", columns=3, rows=3, points=300)
    publish(made.root, folder / "www", "--layer", NDT, "--id-prefix", "/town/")
    shutil.copytree(folder / "town", folder / "changed")
    DividedMap(folder / "changed", corners=dict(made.corners)).change("0_0.pcd", seed=5)
    shutil.copytree(folder / "www", folder / "next")
    publish(folder / "changed", folder / "next", "--layer", NDT)


@pytest.fixture
def town(_published: Path, tmp_path: Path) -> DividedMap:
    """The map's files."""
    source = DividedMap(tmp_path / "town")
    shutil.copytree(_published / "town", source.root)
    made = make_map(tmp_path / "names", columns=3, rows=3, points=1)
    source.corners = dict(made.corners)
    return source


@pytest.fixture
def publish_change(_published: Path, web: FaultyWeb, town: DividedMap) -> Callable[[], None]:
    """Publish another version, in which ``0_0.pcd`` has changed."""

    def change() -> None:
        town.change("0_0.pcd", seed=5)
        shutil.copytree(
            _published / "next", web.folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("CURRENT")
        )
        shutil.copy(_published / "next/CURRENT", web.folder / "CURRENT.new")
        (web.folder / "CURRENT.new").rename(web.folder / "CURRENT")

    return change


@pytest.fixture
def web(_published: Path, tmp_path: Path) -> Iterator[FaultyWeb]:
    """A web server of the published map."""
    shutil.copytree(_published / "www", tmp_path / "www")
    with faulty_web(tmp_path / "www") as one:
        yield one


def listing(client: RawClient) -> list[Any]:
    """All rows of ``metadata``."""
    rows: list[Any] = []
    reply: list[Any] = client.ask("metadata")
    while True:
        rows += reply[4]
        if reply[5] is None:
            return rows
        reply = client.ask("metadata", None, None, reply[5])


def columns_of(cells: Any) -> dict[tuple[str, str], dict[str, bytes]]:
    return {
        (cell.id.rsplit("/", 1)[1], cell.layer): {name: cell[name].tobytes() for name in cell.columns}
        for cell in cells
    }


# --- the same cells -----------------------------------------------------------------------------------


@pytest.fixture(params=["directory", "file", "web", "bucket"])
def url(request: pytest.FixtureRequest, _published: Path) -> tuple[str, dict[str, str]]:
    """Where the town is published, and the environment that it needs."""
    if request.param == "bucket":
        buckets: BucketServer = request.getfixturevalue("buckets")
        publish(_published / "town", buckets.url("served/town"), "--layer", NDT, "--id-prefix", "/town/")
        return buckets.url("served/town"), buckets.environment
    if request.param == "web":
        return request.getfixturevalue("web").url, {}
    return ("" if request.param == "directory" else "file://") + str(_published / "www"), {}


@pytest.mark.usefixtures("layer_kernels")
def test_every_column_is_that_of_the_files(
    url: tuple[str, dict[str, str]], daemon: DaemonFactory, town: DividedMap
) -> None:
    local, remote = daemon(town.root), daemon(url[0], environment=url[1])
    layers: tuple[str, ...] = PUBLISHED
    if url[0].startswith("/"):
        open3d_or_skip()
        layers = (*PUBLISHED, *COMPUTED)
    found = []
    for one in (local, remote):
        with shmmap.connect(one.endpoint) as client:
            cells = client.area(ALL, layers=layers, wait=120.0)
            assert cells.complete, cells.failed
            found.append((columns_of(cells), names(cells)))
            for cell in cells:
                cell.verify()
                assert cell.box == town.box(cell.id.rsplit("/", 1)[1])
                assert cell.frame_id == "map"
    (of_files, order), (of_objects, other_order) = found
    assert len(of_files) == 9 * len(layers)
    assert order == other_order
    assert of_files == of_objects
    with shmmap.connect(remote.endpoint) as client:
        assert {cell.id for cell in client.area(ALL)} == {f"/town/{name}" for name in town.corners}


def test_points_in_millimetres_are_those_that_fetch_writes(
    daemon: DaemonFactory, town: DividedMap, tmp_path: Path
) -> None:
    publish(town.root, tmp_path / "mm", "--encoding", "mm", "--id-prefix", "/town/")
    assert run_verb(["fetch", str(tmp_path / "mm"), str(tmp_path / "back")]).returncode == 0
    found = []
    for path in (tmp_path / "back", tmp_path / "mm"):
        with shmmap.connect(daemon(path).endpoint) as client:
            cells = client.area(ALL, layers=("points", COMPUTED[0]), wait=120.0)
            assert cells.complete, cells.failed
            found.append(columns_of(cells))
            for cell in cells:
                cell.verify()
    assert found[0] == found[1]


def test_a_client_in_cpp_maps_the_same_bytes(
    daemon: DaemonFactory, town: DividedMap, web: FaultyWeb, cpp_program: Path
) -> None:
    found = []
    for one in (daemon(town.root), daemon(web.url)):
        with CppClient(cpp_program, one.endpoint) as client:
            cells = client.around(0.0, 0.0, 100.0, ["points", NDT], wait=60.0)
            assert cells.complete
            for cell in cells:
                if cell.layer == "points":
                    cell.verify()
            found.append([[words[0].rsplit("/", 1)[-1], *words[1:]] for words in client.columns()])
            del cells, cell
            client.release()
    assert found[0] == found[1]


def test_requests_are_answered_as_for_files(
    daemon: DaemonFactory, connect: Connect, town: DividedMap, web: FaultyWeb
) -> None:
    clients = [connect(daemon(town.root)), connect(daemon(web.url))]
    assert clients[1].id_prefix == "/town/"
    assert (clients[0].cells, clients[0].bounds) == (clients[1].cells, clients[1].bounds)
    for x, y, radius in ((0, 0, 25), (-25, 10, 5), (500, 500, 10), (0, 0, 1000)):
        replies = [client.area(circle(x, y, radius)) for client in clients]
        assert names(replies[0].cells) == names(replies[1].cells)
        held = [[handle.version for handle in reply.cells][::2] for reply in replies]
        less = [
            client.differential(circle(x, y, radius / 2), packed=versions)
            for client, versions in zip(clients, held, strict=True)
        ]
        assert names(less[0].cells) == names(less[1].cells)
        assert len(less[0].removed_versions) == len(less[1].removed_versions)
    listed = [{row[0].rsplit("/", 1)[-1]: row[2:6] for row in listing(client)} for client in clients]
    assert sorted(listed[0]) == sorted(listed[1]) == sorted(town.corners)
    assert listed[0] == listed[1]
    for wanted in ("0_0.pcd", "/town/0_0.pcd"):
        (handle,) = clients[1].selected([wanted]).cells
        assert handle.id == "/town/0_0.pcd"
    assert [f.code for f in clients[1].selected(["nowhere.pcd"]).failed] == ["unknown_cell"]


def test_one_loader_fetches_many_objects_at_once(daemon: DaemonFactory, web: FaultyWeb) -> None:
    """All of a window's cells are asked for before the first one has been sent."""
    asked: set[str] = set()

    def stall(path: str) -> str:
        if path.startswith("blobs/") and path not in asked:
            asked.add(path)
            return "stall"
        return ""

    one = daemon(web.url, "--workers", "1")
    web.fault = stall
    with shmmap.connect(one.endpoint) as client:
        client.area(ALL, wait=None)
        until(lambda: len(asked) >= 9)
        web.heal()
        all_cells(client)


# --- out of reach -------------------------------------------------------------------------------------


def offline_codes(cells: Any) -> set[str]:
    return {failure.code for failure in cells.failed}


@pytest.mark.parametrize("how", ["refuse", "stall"])
def test_an_origin_out_of_reach_costs_only_what_is_not_here(
    daemon: DaemonFactory, web: FaultyWeb, how: str
) -> None:
    one = daemon(web.url)
    with shmmap.connect(one.endpoint) as client:
        warm = client.around(0.0, 0.0, 1.0, wait=60.0)
        assert warm.complete
        assert len(warm) == 4
        if how == "refuse":
            web.refuse()
        else:
            web.fault = lambda _path: how
        cold = client.area(ALL, wait=60.0)
        assert offline_codes(cold) == {"offline"}
        assert len(cold.failed) == 5
        assert {cell.id for cell in cold} == {cell.id for cell in warm}
        assert client.around(0.0, 0.0, 1.0, wait=60.0).complete, "what is here is served all the while"
        until_health(one, 1, "out of reach")
        assert "out of reach for" in verb(one, "status")[1]
        logged = one.log.count("load failed")
        until(lambda: offline_codes(client.area(ALL, wait=30.0)) == {"offline"})
        assert one.log.count("load failed") == logged, "it is said once"
        if how == "refuse":
            web.listen()
        web.heal()
        all_cells(client)
        until_health(one, 0)


def test_credentials_that_expire_cost_only_what_is_not_here(
    daemon: DaemonFactory, web: FaultyWeb, tmp_path: Path
) -> None:
    (tmp_path / "store").mkdir()
    web.folder = web.folder.rename(tmp_path / "store/town").parent
    one = daemon("s3://town", environment={**KEYS, "AWS_ENDPOINT_URL": web.url})
    with shmmap.connect(one.endpoint) as client:
        assert client.around(0.0, 0.0, 1.0, wait=60.0).complete
        web.fault = lambda _path: "400 ExpiredToken"
        cold = client.area(ALL, wait=60.0)
        assert (len(cold), offline_codes(cold)) == (4, {"offline"})
        assert all("the credentials have expired" in failure.message for failure in cold.failed)
        assert client.around(0.0, 0.0, 1.0, wait=60.0).complete
        until_health(one, 1, "(`shmmap doctor`)")
        until(lambda: "out of reach" in one.log)
        assert re.search(r"out of reach reason=.*the credentials have expired", one.log)
        web.heal()
        all_cells(client)
    for secret in (KEYS["AWS_ACCESS_KEY_ID"], KEYS["AWS_SECRET_ACCESS_KEY"]):
        assert secret not in one.log


def test_a_daemon_ends_while_its_origin_says_nothing(daemon: DaemonFactory, web: FaultyWeb) -> None:
    one = daemon(web.url)
    with shmmap.connect(one.endpoint) as client:
        web.fault = lambda _path: "stall"
        client.area(ALL, wait=None)
        assert one.stop() == 0


# --- damaged ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fault", "code"), [("corrupt", "load_failed"), ("truncate", "offline")])
def test_a_damaged_body_costs_its_cell_by_name(
    daemon: DaemonFactory, web: FaultyWeb, town: DividedMap, fault: str, code: str
) -> None:
    one = daemon(web.url)
    web.fault = lambda path: fault if path.startswith("blobs/") else ""
    with shmmap.connect(one.endpoint) as client:
        cells = client.area(ALL, wait=60.0)
        assert (len(cells), len(cells.failed), offline_codes(cells)) == (0, 9, {code})
        for failure in cells.failed:
            assert fault == "truncate" or "its SHA-256 is not its name" in failure.message
            assert re.search("blobs/sha256/[0-9a-f]{64}", failure.message)
        web.heal()
        assert {cell.id.rsplit("/", 1)[1] for cell in all_cells(client)} == set(town.corners)


def test_a_body_that_stalls_is_gone_on_with(daemon: DaemonFactory, web: FaultyWeb) -> None:
    one = daemon(web.url)
    web.fault = lambda path: "stall body" if path.startswith("blobs/") else ""
    with shmmap.connect(one.endpoint) as client:
        until(lambda: client.area(ALL, wait=30.0).complete)
    assert 206 in {status for _path, status in web.requests()}


def test_what_was_damaged_once_in_transit_is_fetched_again(daemon: DaemonFactory, web: FaultyWeb) -> None:
    one = daemon(web.url)
    seen: set[str] = set()

    def once(path: str) -> str:
        if path in seen or not path.startswith("blobs/"):
            return ""
        seen.add(path)
        return "corrupt"

    web.fault = once
    with shmmap.connect(one.endpoint) as client:
        assert client.area(ALL, wait=60.0).complete


# --- versions -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["poll", "reload"])
def test_another_version_is_taken_and_unchanged_cells_stay(
    daemon: DaemonFactory, web: FaultyWeb, town: DividedMap, how: str
) -> None:
    one = daemon(web.url, "--poll", "1" if how == "poll" else "0")
    with shmmap.connect(one.endpoint) as client:
        before = {cell.id: cell.version for cell in client.area(ALL, wait=60.0)}
        town.change("0_0.pcd", seed=5)
        town.remove_cell("-20_0.pcd")
        corner = (60, 0)
        town.write_cell("60_0.pcd", corner, random_points(np.random.default_rng(8), corner, 100))
        town.write_metadata()
        web.requests()
        publish(town.root, web.folder, "--layer", NDT)
        if how == "reload":
            assert client.reload().map_version
        until(lambda: {cell.id for cell in client.area(ALL, wait=30.0)} != before.keys())
        after = versions_of(one)
        assert after.keys() == before.keys() - {"/town/-20_0.pcd"} | {"/town/60_0.pcd"}
        same = after.keys() & before.keys() - {"/town/0_0.pcd"}
        assert {cell: after[cell] for cell in same} == {cell: before[cell] for cell in same}
        assert after["/town/0_0.pcd"] != before["/town/0_0.pcd"]
        (changed,) = client.selected(["0_0.pcd"])
        assert changed.xyz[:, 0].tobytes() == town.points("0_0.pcd")["x"].tobytes()
    fetched = [path for path, status in web.requests() if path.startswith("blobs/") and status == 200]
    assert len(fetched) == 5, "the root, two shards, and two cells"


def test_a_version_never_goes_back(
    daemon: DaemonFactory, web: FaultyWeb, publish_change: Callable[[], None]
) -> None:
    """While it runs, at a start, and until ``--accept-version`` names the older one."""
    first = (web.folder / "CURRENT").read_bytes()
    publish_change()
    second = (web.folder / "CURRENT").read_bytes()
    one = daemon(web.url, "--poll", "0")
    served = versions_of(one)
    (web.folder / "CURRENT").write_bytes(first)
    with shmmap.connect(one.endpoint) as client:
        with pytest.raises(shmmap.ShmmapError, match="offers version 1, older than version 2") as refused:
            client.reload()
        assert "--accept-version 1" in refused.value.hint
        until_health(one, 1, "is refused, older")
        assert "version 1, which is offered, is refused, older" in verb(one, "status")[1]
        assert counters(one)["published_refused"] == 1
        (web.folder / "CURRENT").write_bytes(second)
        client.reload()
        until(lambda: not counters(one)["published_refused"])
    assert health(one)[0] == 0
    one.stop()
    (web.folder / "CURRENT").write_bytes(first)
    one.arguments[-1] = "1"
    one.start()
    until_health(one, 1, "is refused, older")
    assert versions_of(one) == served
    one.stop()
    one.arguments += ["--accept-version", "1"]
    one.start()
    assert versions_of(one) != served
    assert health(one)[0] == 0


def test_a_link_lost_during_a_switch_keeps_the_old_version_whole(
    daemon: DaemonFactory, web: FaultyWeb, publish_change: Callable[[], None]
) -> None:
    one = daemon(web.url, "--poll", "0")
    with shmmap.connect(one.endpoint) as client:
        before = {(cell.id, cell.version) for cell in client.area(ALL, wait=60.0)}
        known = {path.name for path in (web.folder / "blobs/sha256").iterdir()}
        publish_change()
        new = {path.name for path in (web.folder / "blobs/sha256").iterdir()} - known
        root = re.search('"root": "([0-9a-f]+)"', (web.folder / "CURRENT").read_text())
        assert root is not None
        web.fault = lambda path: "503" if path.rpartition("/")[2] in new - {root[1]} else ""
        with pytest.raises(shmmap.ShmmapError):
            client.reload()
        cells = client.area(ALL, wait=60.0)
        assert {(cell.id, cell.version) for cell in cells} == before
        assert cells.complete
        web.heal()
        until(lambda: {(cell.id, cell.version) for cell in client.area(ALL, wait=30.0)} != before)


def test_a_version_that_was_pruned_is_served_as_far_as_it_is_here(
    daemon: DaemonFactory, web: FaultyWeb, town: DividedMap
) -> None:
    """A vehicle still serves a version of which the store has nothing left."""
    one = daemon(web.url, "--poll", "0")
    with shmmap.connect(one.endpoint) as client:
        (warm,) = client.selected(["0_0.pcd"], wait=60.0)
        for seed, name in enumerate(town.corners):
            town.change(name, seed=seed)
        publish(town.root, web.folder, "--layer", NDT)
        make_older(web.folder, 40, 1, 2)
        done = run_verb(["versions", str(web.folder), "--prune", "--json"])
        assert json.loads(done.stdout)["versions"] == [1]
        cells = client.area(ALL, wait=60.0)
        assert [(cell.id, cell.version) for cell in cells] == [(warm.id, warm.version)]
        assert offline_codes(cells) == {"load_failed"}
        assert len(cells.failed) == 8
        assert all("is not there" in failure.message for failure in cells.failed)
        client.reload()
        cells = all_cells(client)
        assert len(cells) == 9
        for cell in cells:
            name = cell.id.rsplit("/", 1)[1]
            assert cell.xyz[:, 0].tobytes() == town.points(name)["x"].tobytes()


def test_tags_that_differ_each_time_are_no_other_version(daemon: DaemonFactory, web: FaultyWeb) -> None:
    numbers = itertools.count()
    web.tag = lambda _data: str(next(numbers))
    one = daemon(web.url, "--poll", "1")
    web.requests()
    until_asked(web, "CURRENT", 3, 200)
    assert "reload done" not in one.log
    with shmmap.connect(one.endpoint) as client:
        assert client.area(ALL, wait=60.0).complete


def test_a_tag_that_stays_hides_a_version_from_polls_and_not_from_a_reload(
    daemon: DaemonFactory, web: FaultyWeb, publish_change: Callable[[], None]
) -> None:
    web.tag = lambda _data: "always this"
    one = daemon(web.url, "--poll", "1")
    with shmmap.connect(one.endpoint) as client:
        before = client.area(ALL, wait=60.0)
        publish_change()
        web.requests()
        until_asked(web, "CURRENT", 2, 304)
        assert "reload done" not in one.log
        assert client.area(ALL, wait=60.0).map_version == before.map_version
        client.reload()
        after = client.area(ALL, wait=60.0)
        assert after.complete
        assert after.map_version != before.map_version


# --- many shards --------------------------------------------------------------------------------------


@pytest.fixture
def country(tmp_path: Path) -> Iterator[tuple[DividedMap, FaultyWeb]]:
    """A map of 24 shards, two cells each, in a row along x; and a web server of it."""
    made = DividedMap(tmp_path / "country")
    made.pcd_dir.mkdir(parents=True)
    rng = np.random.default_rng(3)
    for number in range(24):
        for x in (640 * number, 640 * number + 20):
            made.write_cell(f"{x}_0.pcd", (x, 0), random_points(rng, (x, 0), 50))
    made.write_metadata()
    publish(made.root, tmp_path / "www")
    with faulty_web(tmp_path / "www") as web:
        yield made, web


def test_pages_come_as_areas_need_them_and_then_the_rest(
    daemon: DaemonFactory, connect: Connect, country: tuple[DividedMap, FaultyWeb]
) -> None:
    made, web = country
    client = connect(daemon(web.url))
    assert client.cells == 48
    for number in (20, 3, 11):
        reply = client.area(circle(640 * number + 10, 10, 15))
        assert names(reply.cells) == [f"{640 * number}_0.pcd", f"{640 * number + 20}_0.pcd"]
    assert sorted(row[0] for row in listing(client)) == sorted(made.corners)
    found = client.area(["box", -1e5, -1e5, 1e5, 1e5])
    assert {handle.id.rsplit("/", 1)[1] for handle in found.cells} == set(made.corners)


def test_pages_out_of_reach_are_not_waited_for_and_come_by_themselves(
    daemon: DaemonFactory, country: tuple[DividedMap, FaultyWeb]
) -> None:
    _made, web = country
    shards = shard_objects(web.folder)
    held_back = set(shards[1:])
    web.fault = lambda path: "503" if path.rpartition("/")[2] in held_back else ""
    one = daemon(web.url)
    with shmmap.connect(one.endpoint) as client:
        assert client.around(10.0, 10.0, 15.0, wait=30.0).complete
        far = shmmap.Circle(640.0 * 20 + 10, 10.0, 15.0)
        until(lambda: not client.area(far, wait=30.0).covered)
        assert len(client.area(far, wait=30.0)) == 0
        web.heal()
        until(lambda: client.area(far, wait=5.0).complete)
        assert len(client.area(far, wait=5.0)) == 2


def shard_objects(folder: Path) -> list[str]:
    """Names of the objects of the shards, in order, as another reader finds them."""
    import json

    import msgspec
    import zstandard

    current = json.loads((folder / "CURRENT").read_text())
    frame = (folder / "blobs/sha256" / current["root"]).read_bytes()
    root = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame))
    hashes = root["shard_sha256"]
    return [hashes[at : at + 32].hex() for at in range(0, len(hashes), 32)]


# --- restarts -----------------------------------------------------------------------------------------


def test_segments_are_kept_over_a_restart(daemon: DaemonFactory, web: FaultyWeb) -> None:
    one = daemon(web.url)
    with shmmap.connect(one.endpoint) as client:
        assert client.area(ALL, layers=("points", NDT), wait=60.0).complete
        kept = set(one.segments())
    until_taken(one)
    one.leave()
    web.requests()
    one.start()
    with shmmap.connect(one.endpoint) as client:
        assert client.area(ALL, layers=("points", NDT), wait=60.0).complete
        assert set(one.segments()) == kept
    assert not [path for path, _ in web.requests() if path.startswith("blobs/")], "root and shards are here"


def test_a_start_without_a_link_serves_what_was_taken(
    daemon: DaemonFactory, web: FaultyWeb, publish_change: Callable[[], None]
) -> None:
    """Out of the disk, all of it: the list of cells, points, and published layers."""
    one = daemon(web.url, "--poll", "1")
    with shmmap.connect(one.endpoint) as client:
        before = client.area(ALL, layers=PUBLISHED, wait=60.0)
        assert before.complete
        versions = {(cell.id, cell.layer, cell.version) for cell in before}
        del before
    until_taken(one)
    one.stop()
    web.refuse()
    one.start()
    with shmmap.connect(one.endpoint) as client:
        again = client.area(ALL, layers=PUBLISHED, wait=60.0)
        assert again.complete
        assert {(cell.id, cell.layer, cell.version) for cell in again} == versions
        until(lambda: health(one)[0] == 1)
    publish_change()
    web.listen()
    with shmmap.connect(one.endpoint) as client:
        until(lambda: {(c.id, c.layer, c.version) for c in client.area(ALL, layers=PUBLISHED)} != versions)


def test_a_start_with_nothing_on_the_disk_and_without_a_link(daemon: DaemonFactory, web: FaultyWeb) -> None:
    one = daemon(web.url)
    until_taken(one)
    one.stop()
    shutil.rmtree(one.cache_dir)
    web.refuse()
    one.start()
    with shmmap.connect(one.endpoint) as client:
        nothing = client.area(ALL, wait=30.0)
        assert (len(nothing), nothing.covered) == (0, False)
        web.listen()
        all_cells(client)


@pytest.mark.parametrize("step", ["taken.written", "taken.named", "tier.written", "daemon.linked"])
def test_killed_while_it_takes_a_version(
    daemon: DaemonFactory,
    connect: Connect,
    web: FaultyWeb,
    publish_change: Callable[[], None],
    tmp_path: Path,
    step: str,
) -> None:
    """Without a link the next start has the version of before, or this one: all of one of them."""
    one = daemon(web.url, "--poll", "0")
    with shmmap.connect(one.endpoint) as client:
        before = {(cell.id, cell.version) for cell in client.area(ALL, wait=60.0)}
    until_taken(one)
    one.leave()
    one.environment["SHMMAP_TEST_CRASH"] = f"{step}:1:{tmp_path}/reached"
    publish_change()
    one.start()
    raw, waiting = connect(one, timeout=1.0), Deadline()
    while waiting(not (tmp_path / "reached").exists()):
        with suppress(TimeoutError, DaemonError):
            raw.ask("reload")
            raw.area(circle(0, 0, 1000), wait=1.0)
    del one.environment["SHMMAP_TEST_CRASH"]
    one.kill()
    web.refuse()
    one.start()
    with shmmap.connect(one.endpoint) as client:
        cells = client.area(ALL, wait=60.0)
        found = {(cell.id, cell.version) for cell in cells}
        missing = {failure.cell_id for failure in cells.failed}
        assert cells.covered
        assert len(found | {(cell, 0) for cell in missing}) == 9
        assert missing <= {"/town/0_0.pcd"}, "only what changed may not be here"
        assert len(found & before) >= 8
        web.listen()
        all_cells(client)


# --- what is refused, what is kept quiet --------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["ftp://host/map"], 2, "a map cannot lie at ftp://"),
        (["http://example.invalid/map"], 2, "--insecure-http"),
        (["https://me:secret@host/map"], 2, "may hold a secret"),
        (["file:///nowhere/at/all"], 66, "no map is published"),
        (["http://127.0.0.1:9/map"], 71, "no answer"),
        (["http://127.0.0.1:9/map", "--watch"], 78, "--watch is not for a published map"),
        (["http://127.0.0.1:9/map", "--poll", "0.1"], 78, "--poll cannot be 0.1"),
    ],
)
def test_what_cannot_be_served_is_refused(
    daemon: DaemonFactory, words: list[str], code: int, says: str
) -> None:
    one = daemon(*words, start=False)
    assert one.run_to_end() == code
    assert says in one.log
    assert "secret@" not in one.log


@pytest.mark.parametrize(
    ("package", "url"), [("obstore", "s3://m/map"), ("zstandard", "http://127.0.0.1:9/map")]
)
def test_without_a_package_it_is_said_what_to_install(
    daemon: DaemonFactory, tmp_path: Path, package: str, url: str
) -> None:
    one = daemon(url, start=False, environment=without(package, tmp_path))
    assert one.run_to_end() == 69
    assert "pip install obstore zstandard" in one.log


def loaded(pid: int) -> str:
    return Path(f"/proc/{pid}/maps").read_text()


def test_a_daemon_of_files_loads_nothing_of_this(daemon: DaemonFactory, town: DividedMap) -> None:
    one = daemon(town.root, forked=False)
    with shmmap.connect(one.endpoint) as client:
        assert client.area(ALL, wait=60.0).complete
    for pid in (one.pid, *one.children()):
        assert not re.search("obstore|zstandard", loaded(pid))


def test_no_other_address_is_asked_and_no_secret_is_shown(
    buckets: BucketServer, daemon: DaemonFactory, town: DividedMap, tmp_path: Path
) -> None:
    """Nor the cloud's metadata address where there are no credentials: the store is asked without any."""
    publish(town.root, buckets.url("private"))
    shim, seen = built_preload("connects", tmp_path), tmp_path / "connects"
    watched = {"HOME": str(tmp_path), "LD_PRELOAD": str(shim), "CONNECTS_SEEN": str(seen)}
    keyless = {**dict.fromkeys(buckets.environment, ""), "AWS_ENDPOINT_URL": buckets.endpoint, **watched}
    assert daemon(buckets.url("private"), environment=keyless, start=False).run_to_end() == 71
    one = daemon(buckets.url("private"), "--poll", "1", environment={**buckets.environment, **watched})
    with shmmap.connect(one.endpoint) as client:
        assert client.area(ALL, wait=60.0).complete
        client.reload()
    assert set(seen.read_text().split()) == {"127.0.0.1"}
    secret = buckets.environment["AWS_SECRET_ACCESS_KEY"]
    shown = [Path(f"/proc/{pid}/cmdline") for pid in (one.pid, *one.children())]
    for path in (*shown, *Path(one.shm_dir).iterdir()):
        assert secret.encode() not in path.read_bytes()
    assert secret not in one.log
