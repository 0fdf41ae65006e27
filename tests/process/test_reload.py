# SPDX-License-Identifier: Apache-2.0
"""Changed, new and deleted files take effect per cell and at once; what is broken changes nothing."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, first_answer, until
from tests.support.divided_map import DividedMap, random_points
from tests.support.mapping_process import MappingProcess
from tests.support.raw_client import DaemonError, RawClient, circle
from tests.support.segment_reader import assert_same_points, map_segment, names, parse

Connect = Callable[..., RawClient]


def test_changed_new_and_deleted_cells(client: RawClient, divided_map: DividedMap) -> None:
    first = client.area(circle(0, 0, 25))
    held = {handle.id.rsplit("/", 1)[1]: handle.version for handle in first.cells}
    divided_map.change("0_0.pcd", 5)
    divided_map.remove_cell("0_-20.pcd")
    corner = (60, 0)
    divided_map.write_cell("60_0.pcd", corner, random_points(np.random.default_rng(8), corner, 100))
    divided_map.write_metadata()
    assert client.differential(circle(0, 0, 25), packed=list(held.values())).cells == []  # not yet

    reloaded = client.ask("reload")
    assert reloaded[3:6] == [1, 1, 1]
    assert reloaded[2] != client.map_version
    for rows, packed in (([[n, v] for n, v in held.items()], []), ([], list(held.values()))):
        reply = client.differential(circle(0, 0, 25), rows, packed=packed)
        assert reply.map_version == reloaded[2]
        assert names(reply.cells) == ["0_0.pcd"]
        assert reply.cells[0].version != held["0_0.pcd"]
        assert_same_points(client, reply.cells[0], divided_map)
        assert reply.removed == (["0_-20.pcd"] if rows else [])
        assert reply.removed_versions == ([] if rows else [held["0_-20.pcd"]])
    assert names(client.area(circle(70, 10, 1)).cells) == ["60_0.pcd"]
    gone = client.selected(["0_-20.pcd"])
    assert [f.code for f in gone.failed] == ["unknown_cell"]


def test_metadata_since_a_map_version(client: RawClient, divided_map: DividedMap) -> None:
    before = client.map_version
    nothing = client.ask("metadata", None, before)
    assert (nothing[4], nothing[6], nothing[7]) == ([], True, [])
    divided_map.change("0_0.pcd", 5)
    divided_map.remove_cell("0_-20.pcd")
    divided_map.write_metadata()
    client.ask("reload")
    page = client.ask("metadata", None, before)
    assert [row[0].rsplit("/", 1)[-1] for row in page[4]] == ["0_0.pcd"]
    assert (page[5], page[6]) == (None, True)
    assert [r.rsplit("/", 1)[-1] for r in page[7]] == ["0_-20.pcd"]
    unknown = client.ask("metadata", None, 12345)
    assert (len(unknown[4]), unknown[6]) == (35, False)


def test_the_signal(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    old = client.selected(["0_0.pcd"])
    divided_map.change("0_0.pcd", 5)
    one.send(signal.SIGHUP)
    reply = client.selected(["0_0.pcd"])
    reply = first_answer(lambda: client.selected(["0_0.pcd"]), lambda one: one.map_version != old.map_version)
    assert_same_points(client, reply.cells[0], divided_map)


def test_a_file_rewritten_in_place_with_its_old_times(client: RawClient, divided_map: DividedMap) -> None:
    """Same size, same mtime: the change time shows it."""
    old = client.selected(["0_0.pcd"]).cells[0]
    path = divided_map.pcd_dir / "0_0.pcd"
    status = path.stat()
    data = bytearray(path.read_bytes())
    data[-4:] = np.float32(77).tobytes()
    with path.open("r+b") as file:
        file.write(data)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert client.ask("reload")[3:6] == [1, 0, 0]
    new = client.selected(["0_0.pcd"]).cells[0]
    assert new.version != old.version
    assert_same_points(client, new, divided_map)


def test_a_half_written_file_leaves_the_old_version_in_service(
    client: RawClient, divided_map: DividedMap
) -> None:
    old = client.selected(["0_0.pcd"]).cells[0]
    path = divided_map.pcd_dir / "0_0.pcd"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    client.ask("reload")
    reply = client.selected(["0_0.pcd"])  # a client without it gets the old one, marked stale
    assert [f.code for f in reply.failed] == ["load_failed"]
    assert [(h.segment, h.version, h.stale) for h in reply.cells] == [(old.segment, old.version, True)]
    for rows, packed in (([["0_0.pcd", old.version]], []), ([], [old.version])):
        kept = client.differential(circle(10, 10, 1), rows, packed=packed)  # a client that has it keeps it
        assert (kept.cells, kept.removed, kept.removed_versions) == ([], [], [])
        assert [f.code for f in kept.failed] == ["load_failed"]
    divided_map.change("0_0.pcd", 6)
    client.ask("reload")
    reply = client.differential(circle(10, 10, 1), packed=[old.version])
    assert (len(reply.cells), reply.failed) == (1, [])
    assert not reply.cells[0].stale
    assert_same_points(client, reply.cells[0], divided_map)


def test_a_broken_catalogue_changes_nothing(client: RawClient, divided_map: DividedMap) -> None:
    path = divided_map.root / "pointcloud_map_metadata.yaml"
    text = path.read_text()
    for broken, code in (("x_resolution: [", "bad_map_data"), (None, ""), ("", "bad_map_data")):
        if broken is None:
            path.unlink()
        else:
            path.write_text(broken)
        with pytest.raises(DaemonError) as failure:
            client.ask("reload")
        if code:
            assert failure.value.code == code
        assert names(client.area(circle(0, 0, 5)).cells) == divided_map.in_circle(0, 0, 5)
    path.write_text(text)
    assert client.ask("reload")[3:6] == [0, 0, 0]


def test_old_versions_stay_while_a_process_maps_them(
    served: DaemonProcess, client: RawClient, divided_map: DividedMap
) -> None:
    old = client.selected(["0_0.pcd"]).cells[0]
    with MappingProcess([client.path(old)]) as reader:
        before = reader.checksums()
        divided_map.change("0_0.pcd", 5)
        client.ask("reload")
        new = client.selected(["0_0.pcd"]).cells[0]
        assert new.segment != old.segment
        assert reader.checksums() == before
        until(lambda: any(name.endswith(".zombie") for name in served.segments()))
        assert len(served.segments()) == 2
    served.until_segments(1, lambda: client.ask("stats"))


def test_reload_repeatedly_while_clients_ask(
    served: DaemonProcess, connect: Connect, divided_map: DividedMap
) -> None:
    """Whatever a reply names is one whole state of its file, and the last one comes in the end."""
    asker, changer = connect(served), connect(served)
    states = {divided_map.points("0_0.pcd")["x"].tobytes()}
    for round_ in range(12):
        divided_map.change("0_0.pcd", round_, 200 + 10 * round_)
        states.add(divided_map.points("0_0.pcd")["x"].tobytes())
        pending = changer.send("reload")
        for _ in range(5):
            reply = asker.selected(["0_0.pcd"])
            for handle in reply.cells:
                try:
                    mapped = map_segment(asker.path(handle))
                except FileNotFoundError:
                    continue  # superseded since: a client asks again
                seen = parse(mapped).columns["xyz"][:, 0].tobytes()
                assert seen in states
        changer.wait_for(pending)
    final = asker.selected(["0_0.pcd"]).cells[0]
    assert_same_points(asker, final, divided_map)


@pytest.mark.slow
def test_endless_metadata_changes_nothing(client: RawClient, divided_map: DividedMap) -> None:
    old = client.selected(["0_0.pcd"]).cells[0]
    metadata = divided_map.root / "pointcloud_map_metadata.yaml"
    good = metadata.read_text()
    for line in ("a.pcd: [{}, 0]", "? {}.pcd\n: [0, 0]", "{}", "a.pcd: [[{}"):
        metadata.write_text(good + line.format("7" * 1_000_000))
        with pytest.raises(DaemonError) as caught:
            client.ask("reload")
        assert caught.value.code == "bad_map_data"
        assert client.last_bytes < 1000
        assert client.ask("stats")[4]["defects"] == 0
        assert client.selected(["0_0.pcd"]).cells[0].version == old.version
    metadata.write_text(good + "#" * 1_000_000 + "\n")  # as long, and sound
    divided_map.change("0_0.pcd", 5)
    assert client.ask("reload")[3:6] == [1, 0, 0]
    assert client.selected(["0_0.pcd"]).cells[0].version != old.version
