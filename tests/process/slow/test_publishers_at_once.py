# SPDX-License-Identifier: Apache-2.0
"""Two programs at one store: what one does between any two steps of the other leaves every version whole."""

from __future__ import annotations

from pathlib import Path

import pytest

from shmmap.errors import BadRequest, InstanceBusy, MapMissing, ShmmapError
from shmmap.origin.map_directory import open_map
from tests.process.conftest import Meanwhile
from tests.support.command_line import make_older
from tests.support.divided_map import DividedMap, make_map
from tests.support.published_maps import PublishedMapReader

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote import map_versions
from shmmap.origin.remote.opened_store import open_store
from shmmap.progress import NoProgress
from shmmap.publishing import prune, publish, restore
from shmmap.publishing.messages import PublishSettings
from shmmap.publishing.prune import Pruned
from shmmap.publishing.publish import Published
from shmmap.publishing.restore import Restored


@pytest.fixture
def town(tmp_path: Path) -> DividedMap:
    return make_map(tmp_path / "town", columns=1, rows=2, points=100)


class Program:
    """What programs do at one store."""

    def __init__(self, folder: Path, town: DividedMap) -> None:
        self.folder = folder
        self.store = open_store(str(folder))
        self.town = town

    def publish(self, seed: int) -> Published:
        self.town.change(next(iter(self.town.corners)), seed)
        catalogue = open_map(self.town.root).load()
        settings = PublishSettings(self.store.url)
        return publish.publish_map(
            catalogue, self.store, (), settings=settings, workers=1, progress=NoProgress()
        )

    def restore(self, version: int) -> Restored:
        return restore.restore_version(self.store, version, NoProgress())

    def prune(self) -> Pruned:
        return prune.prune_versions(self.store, keep_days=30, progress=NoProgress())

    def current(self) -> int:
        """The current version, whole."""
        return int(PublishedMapReader(self.folder).current["version"])


@pytest.fixture
def program(tmp_path: Path, town: DividedMap) -> Program:
    """Three versions; the first has not been current for 40 days, and everything is old."""
    made = Program(tmp_path / "store", town)
    for seed in (1, 2, 3):
        made.publish(seed)
    for version, days in ((1, 50), (2, 40), (3, 20)):
        make_older(made.folder, days, version)
    make_older(made.folder, 999)
    return made


@pytest.mark.parametrize(
    "label",
    ["publish.shard", "publish.send", "publish.root", "version.entry", "version.switch", "version.switched"],
)
def test_another_goes_back_and_prunes_while_one_publishes(
    label: str, program: Program, meanwhile: Meanwhile
) -> None:
    def act() -> int | None:
        version = program.restore(2).version
        assert program.prune().versions[0] == 1
        program.current()
        return version

    outcome = meanwhile(label, act)
    if label == "version.switched":
        assert program.publish(4).version == 4
        assert program.current() == 5
    else:
        with pytest.raises(InstanceBusy, match="another publisher has changed"):
            program.publish(4)
        assert program.current() == outcome[0]
        assert program.publish(4).version == program.current()
    assert not isinstance(outcome[0], ShmmapError)
    assert 1 not in map_versions.list_entries(program.store)


@pytest.mark.parametrize(
    ("label", "came_of_it"),
    [("restore.entry", MapMissing), ("restore.looked", 4), ("version.switch", 4), ("version.switched", 4)],
)
def test_another_prunes_while_one_goes_back(
    label: str, came_of_it: int | type[ShmmapError], program: Program, meanwhile: Meanwhile
) -> None:
    outcome = meanwhile(label, program.prune)
    if isinstance(came_of_it, int):
        assert program.restore(1).version == came_of_it == program.current()
    else:
        with pytest.raises(came_of_it, match="has just been pruned"):
            program.restore(1)
        assert program.current() == 3
    assert isinstance(outcome[0], Pruned)
    assert 1 in outcome[0].versions
    program.prune()
    program.current()


@pytest.mark.parametrize(
    ("label", "came_of_it"), [("prune.entry", 4), ("prune.listed", MapMissing), ("prune.object", MapMissing)]
)
def test_another_goes_back_while_one_prunes(
    label: str, came_of_it: int | type[ShmmapError], program: Program, meanwhile: Meanwhile
) -> None:
    outcome = meanwhile(label, lambda: program.restore(1))
    assert program.prune().versions == [1]
    if isinstance(came_of_it, int):
        assert isinstance(outcome[0], Restored)
        assert outcome[0].version == came_of_it == program.current()
    else:
        assert isinstance(outcome[0], came_of_it)
        assert program.current() == 3
    with pytest.raises((MapMissing, BadRequest)):
        program.restore(1)


def test_what_is_sent_again_while_one_prunes_stays(program: Program, meanwhile: Meanwhile) -> None:
    """The content of version 1 is published again, after its objects were listed as old."""
    outcome = meanwhile("prune.object", lambda: program.publish(1))
    pruned = program.prune()
    assert pruned.versions == [1]
    assert isinstance(outcome[0], Published)
    assert outcome[0].version == program.current() == 4
    assert program.prune().objects == 0
    program.current()
