# SPDX-License-Identifier: Apache-2.0
"""Directories under names that another account could have taken: used if private, else refused by name."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest

from shmmap.cli.program import write_text
from shmmap.dividing.workspace import Workspace
from shmmap.errors import CannotWrite, InstanceBusy
from shmmap.formats.durable_file import appearing_file, writing_errors
from shmmap.layers.disk_cache import LayerCache
from shmmap.origin.remote.object_tier import ObjectTier
from shmmap.origin.remote.opened_store import DirectoryStore
from shmmap.origin.remote.taken_version import TakenVersion, TakenVersionFile
from shmmap.private_directory import (
    CLOSED,
    PRIVATE,
    NotPrivate,
    open_private,
    opened_private,
    require_private,
    within,
)
from tests.support.accounts import OTHER_USER

Plant = Callable[[Path, Path], object]


def of_other_account(path: Path, victim: Path) -> None:
    del victim
    path.mkdir(mode=0o700)
    os.chown(path, OTHER_USER, OTHER_USER)


def closed_too_late(path: Path, victim: Path, mode: int = 0o777) -> None:
    del victim
    path.mkdir()
    path.chmod(mode)


PLANTED: dict[str, tuple[Plant, str]] = {
    "is a symbolic link": (lambda path, victim: path.symlink_to(victim), "see who made it and remove it"),
    "is no directory": (lambda path, _: path.write_text("x"), "see who made it"),
    "may be written by other users (mode 0777)": (closed_too_late, "remove it; or, if"),
    "may be written by other users (mode 0775)": (
        lambda path, victim: closed_too_late(path, victim, 0o775),
        "chmod go-w",
    ),
    f"belongs to user {OTHER_USER}, not to user {os.geteuid()}": (of_other_account, "see who made it"),
}


@pytest.fixture(params=[pytest.param(why, marks=[pytest.mark.root] * ("belongs" in why)) for why in PLANTED])
def planted(request: pytest.FixtureRequest) -> tuple[str, str, Plant]:
    plant, hint = PLANTED[request.param]
    return request.param, hint, plant


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A directory of this user, to which a planted link leads."""
    path = tmp_path / "victim"
    (path / "map").mkdir(parents=True)
    (path / "lock").write_text("")
    (path / "map" / "mine").write_text("mine")
    return path


def test_what_others_may_have_planted_is_refused_by_name(
    planted: tuple[str, str, Plant], tmp_path: Path, victim: Path
) -> None:
    why, hint, plant = planted
    plant(tmp_path / "place", victim)
    for make in (0, PRIVATE):
        with pytest.raises(NotPrivate) as refused:
            open_private(tmp_path / "place", make=make)
        assert (refused.value.filename, refused.value.strerror) == (str(tmp_path / "place"), f"it {why}")
    with pytest.raises(NotPrivate):
        require_private(tmp_path / "place")
    plant(tmp_path / ".map.fetching", victim)
    with pytest.raises(CannotWrite, match=r"\.map\.fetching: it ") as wrong:
        Workspace(str(tmp_path / "map"), "fetching")
    assert why in wrong.value.message
    assert hint in wrong.value.hint
    assert (victim / "map" / "mine").read_text() == "mine"


def write_below(path: Path) -> None:
    with writing_errors(str(path)), appearing_file(path / "file") as file:
        file.write(b"x")


OUTPUTS: dict[str, Callable[[Path], object]] = {
    "text": lambda path: write_text(path, "x"),
    "file in it": write_below,
    "store": lambda path: DirectoryStore(str(path)).put("blobs/a", b"x"),
}


@pytest.mark.root
@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("kind", ["link", "link to nothing", "pipe"])
def test_outputs_do_not_follow_what_another_account_has_planted(
    tmp_path: Path, victim: Path, output: str, kind: str
) -> None:
    if output == "text":
        victim = victim / "lock"
    before = sorted(tmp_path.rglob("*"))
    place = tmp_path / "out"
    if kind == "pipe":
        os.mkfifo(place)
    else:
        place.symlink_to(victim if kind == "link" else tmp_path / "new")
    os.chown(place, OTHER_USER, OTHER_USER, follow_symlinks=False)
    with pytest.raises(CannotWrite) as refused:
        OUTPUTS[output](place)
    if not (output == "store" and kind != "link"):  # it is no directory
        assert f"is a link, a pipe or a device of user {OTHER_USER}" in refused.value.message
        assert "see who made it" in refused.value.hint
    assert sorted(tmp_path.rglob("*")) == sorted([*before, place])
    assert not victim.is_file() or not victim.read_text()


@pytest.mark.root
def test_nothing_is_made_below_a_link_of_another_account(tmp_path: Path, victim: Path) -> None:
    """State, caches and kernels in a directory that the environment names, such as one in /tmp."""
    (tmp_path / "place").symlink_to(victim)
    os.chown(tmp_path / "place", OTHER_USER, OTHER_USER, follow_symlinks=False)
    before = sorted(victim.rglob("*"))
    with pytest.raises(NotPrivate, match="is a link, a pipe or a device"):
        require_private(tmp_path / "place" / "shmmap" / "origins")
    cache = str(tmp_path / "place" / "shmmap")
    assert not ObjectTier(cache, limit_bytes=1 << 20, quiet=True).put(bytes(32), b"x")
    with pytest.raises(CannotWrite, match="is a link, a pipe or a device"):
        LayerCache(cache, limit_bytes=1 << 20).make()
    assert sorted(victim.rglob("*")) == before


@pytest.mark.parametrize("output", OUTPUTS)
def test_outputs_follow_a_link_of_this_user(tmp_path: Path, output: str) -> None:
    (tmp_path / "there").mkdir()
    target = tmp_path / "there" / "file" if output == "text" else tmp_path / "there"
    (tmp_path / "between").symlink_to(target)
    (tmp_path / "out").symlink_to("between")
    OUTPUTS[output](tmp_path / "out")
    assert [path.name for path in (tmp_path / "there").iterdir()] == [
        "blobs" if output == "store" else "file"
    ]
    with opened_private(tmp_path / "out", own_link=True) if output == "store" else nullcontext():
        pass  # through both links


def test_a_directory_is_made_for_this_user_alone(tmp_path: Path) -> None:
    before = os.umask(0o002)
    try:
        with opened_private(tmp_path / "place", make=PRIVATE) as fd:
            assert os.fstat(fd).st_mode & 0o777 == 0o700
            (tmp_path / "place").rename(tmp_path / "elsewhere")
            Path(within(fd, "file")).write_text("x")
        with Workspace(str(tmp_path / "map")) as space:
            assert os.stat(space.path).st_mode & 0o777 == 0o700
            assert os.stat(space.directory("map")).st_mode & 0o777 == 0o775  # as the user's other outputs
    finally:
        os.umask(before)
    assert (tmp_path / "elsewhere" / "file").exists()
    (tmp_path / "elsewhere").chmod(0o755)
    with opened_private(tmp_path / "elsewhere"):  # others may read it
        pass
    with pytest.raises(NotPrivate, match="may be read by other users"):
        open_private(tmp_path / "elsewhere", refused=CLOSED)
    tmp_path.chmod(0o777)
    with pytest.raises(NotPrivate, match=f"mode 0777.*{tmp_path}"):
        require_private(tmp_path / "elsewhere")  # others could exchange it
    tmp_path.chmod(0o1777)
    require_private(tmp_path / "elsewhere")


def test_state_of_another_account_is_not_taken(tmp_path: Path) -> None:
    """The version that a daemon serves until a newer one is taken, and the memory of signed metadata."""
    file = TakenVersionFile(str(tmp_path), "default", "s3://map")
    taken = TakenVersion("default", "s3://map", "", 3, b"root", 0.0)
    file.save(taken)
    assert file.load() == taken
    origins = tmp_path / "origins"
    origins.chmod(0o777)
    assert file.load() is None
    assert f"{origins}: it may be written by other users (mode 0777) (remove it" in file.problem
    with pytest.raises(CannotWrite, match="may be written"):
        file.save(taken)
    origins.chmod(0o700)
    origins.rename(tmp_path / "aside")
    origins.symlink_to(tmp_path / "aside")
    assert file.load() is None
    assert "is a symbolic link" in file.problem


def test_a_directory_that_is_no_workspace_is_not_emptied(tmp_path: Path, victim: Path) -> None:
    """Another account may have renamed it where it may write to the directory above."""
    (victim / "lock").unlink()
    victim.rename(tmp_path / ".map.dividing")
    with pytest.raises(CannotWrite, match="it is not of an interrupted run"):
        Workspace(str(tmp_path / "map"))
    assert (tmp_path / ".map.dividing" / "map" / "mine").exists()


@pytest.mark.parametrize("kind", ["link", "fifo", "directory"])
def test_a_planted_lock(tmp_path: Path, kind: str) -> None:
    place = tmp_path / ".map.dividing"
    place.mkdir(mode=0o700)
    if kind == "link":
        (place / "lock").symlink_to(tmp_path / "new")
    elif kind == "fifo":
        os.mkfifo(place / "lock")
    else:
        (place / "lock").mkdir()
    with pytest.raises(CannotWrite):
        Workspace(str(tmp_path / "map"))
    assert not (tmp_path / "new").exists()


def test_nothing_is_removed_or_written_through_links(tmp_path: Path, victim: Path) -> None:
    with pytest.raises(FileNotFoundError), Workspace(str(tmp_path / "map"), keep_failed=True) as space:  # noqa: PT012
        space.save({"a": 1})
        Path(space.path, "none").read_bytes()
    place = tmp_path / ".map.dividing"
    (place / "map").symlink_to(victim)
    (place / "state.json.new").symlink_to(victim / "map" / "mine")
    (place / "more").symlink_to(victim / "map")
    with Workspace(str(tmp_path / "map")) as space:
        assert space.state() is not None
        with pytest.raises(NotADirectoryError):
            space.directory("map")
        with pytest.raises(NotADirectoryError):
            space.directory("map/cells")
        space.save({"a": 2})
        space.empty()
        assert os.listdir(space.path) == ["lock"]
    assert sorted(path.name for path in victim.rglob("*")) == ["lock", "map", "mine"]
    assert (victim / "map" / "mine").read_text() == "mine"
    assert not place.exists()


def test_a_state_that_is_a_link_or_a_pipe_is_none(tmp_path: Path) -> None:
    for make in (lambda path: path.symlink_to("/etc/hostname"), os.mkfifo):
        with Workspace(str(tmp_path / "map")) as space:
            make(Path(space.path, "state.json"))
            assert space.state() is None


def test_the_name_is_exchanged_in_mid_run(tmp_path: Path, victim: Path) -> None:
    """The run goes on in its own directory, and ends without touching what has the name now."""
    place = tmp_path / ".map.dividing"
    with Workspace(str(tmp_path / "map")) as space:
        content = Path(space.directory("map"))
        place.rename(tmp_path / "aside")
        place.symlink_to(victim)
        (content / "cell").write_text("ours")
        space.empty()
        (Path(space.directory("map")) / "cell").write_text("ours")
        space.publish(replace=False, durable=False)
    assert (tmp_path / "map" / "cell").read_text() == "ours"
    assert (victim / "map" / "mine").read_text() == "mine"
    assert place.is_symlink()


def test_a_run_beside_another_is_busy_and_errors_name_the_directory(tmp_path: Path) -> None:
    with Workspace(str(tmp_path / "map")) as space:
        with pytest.raises(InstanceBusy):
            Workspace(str(tmp_path / "map"))
        path = space.path
    with pytest.raises(OSError, match=r"\.map\.dividing/none") as wrong, Workspace(str(tmp_path / "map")):
        (Path(path) / "none").read_text()
    assert wrong.value.filename == str(tmp_path / ".map.dividing" / "none")


@pytest.mark.root
def test_a_published_directory_with_links_of_another_account(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "precious").write_text("x")
    root = tmp_path / "published"
    root.mkdir()
    store = DirectoryStore(str(root))
    for name in ("blobs", "versions"):
        (root / name).symlink_to(victim)
    store.put("versions/1.json", b"own links are followed")
    listed = sorted(found.path for found in store.list("blobs/"))
    assert listed == ["blobs/1.json", "blobs/precious"]
    store.delete("versions/1.json")
    for name in ("blobs", "versions"):
        os.lchown(root / name, OTHER_USER, OTHER_USER)
    for attempt in (
        lambda: store.put("versions/1.json", b"x"),
        lambda: store.put_new("versions/1.json", b"x"),
        lambda: store.delete("blobs/precious"),
    ):
        with pytest.raises(CannotWrite, match="another account's link"):
            attempt()
    assert list(store.list("blobs/")) == []
    assert os.listdir(victim) == ["precious"]
    store.put("new/below/a", b"x")
    assert [found.path for found in store.list("new/")] == ["new/below/a"]


@pytest.mark.root
def test_new_keys_are_not_put_into_a_directory_of_another_account(tmp_path: Path) -> None:
    signing = pytest.importorskip("shmmap.publishing.signing")
    keys = tmp_path / "keys"
    keys.mkdir()
    os.chown(keys, OTHER_USER, OTHER_USER)
    store = DirectoryStore(str(tmp_path / "published"))
    with pytest.raises(CannotWrite, match=f"belongs to user {OTHER_USER}"):
        signing.MapSigner(store, str(keys))
    assert os.listdir(keys) == []
    os.chown(keys, 0, 0)
    signing.MapSigner(store, str(keys))
    assert "ROOT.json" in os.listdir(keys)
