# SPDX-License-Identifier: Apache-2.0
"""A rosbag2 bag: a directory or one file of it (sqlite3, MCAP), read without ROS by the package rosbags."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shmmap import BadRequest, MapDataError
from shmmap.errors import MapMissing, ShmmapError
from shmmap.layers import needed_packages
from shmmap_clients.closed_at_end import ClosedAtEnd
from shmmap_clients.scans.scan_file import SCAN_SUFFIXES

_FILES: Final = (".db3", ".mcap")
_COMPRESSED: Final = tuple(f"{suffix}.zstd" for suffix in _FILES)
_NOT_READ: Final = (".bag", *_COMPRESSED)
"""Files that are recognised, to be refused with a remedy."""
_METADATA: Final = "metadata.yaml"
_RECOVER: Final = {
    ".mcap": "`mcap recover {0} -o NEW.mcap` saves what is whole",
    ".db3": "`sqlite3 {0} .recover | sqlite3 NEW.db3` saves what is whole",
}
_REINDEX: Final = "`ros2 bag reindex {0}` writes its metadata.yaml again, from files that are whole"
_SERIALIZED: Final = "cdr"
_ZSTD: Final = b"\x28\xb5\x2f\xfd"  # no beginning of CDR


def is_bag(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a bag by its name, or a directory by the names in it."""
    name = os.fspath(path)
    if not os.path.isdir(name):
        return name.lower().endswith((*_FILES, *_NOT_READ))
    try:
        names = [entry.lower() for entry in os.listdir(name)]
    except OSError:
        return False  # reading scans from it reports the reason
    if any(entry.endswith((*_FILES, *_COMPRESSED)) for entry in names):
        return True
    return _METADATA in names and not any(entry.endswith(SCAN_SUFFIXES) for entry in names)


def split_moment(text: str) -> tuple[str, float] | None:
    """Return the bag and the seconds of ``BAG@SECONDS``; None if the text is a file.

    Raises
    ------
    BadRequest
        The text is a bag without a time.
    """
    path, at, seconds = text.rpartition("@")
    if at and not os.path.exists(text) and is_bag(path):
        with contextlib.suppress(ValueError):
            return path, float(seconds)
    if is_bag(text):
        raise BadRequest(
            f"{text} is a bag: which of its scans?",
            hint=f"{text}@SECONDS is the one nearest to that time since the bag's begin",
        )
    return None


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag.

    Attributes
    ----------
    type
        Type of its messages, such as ``sensor_msgs/msg/PointCloud2``; several are separated by commas.
    messages
        Number of messages.
    """

    type: str
    messages: int


class Bag(ClosedAtEnd):
    """A bag that is open for reading.

    Parameters
    ----------
    path
        Directory of a bag, or one file of it.

    Attributes
    ----------
    path
    topics
        Topics by name.
    begin_ns, end_ns
        Times of the first and the last message, as recorded.

    Raises
    ------
    PackageMissing
        The package rosbags is not installed.
    MapMissing
        There is no such bag.
    MapDataError
        The bag is damaged or incomplete, or is none that rosbags reads.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        with needed_packages("a bag", together="rosbags"):
            from rosbags.rosbag2 import Reader
            from rosbags.typesys import Stores, get_typestore

        self.path = os.fspath(path)
        self._types = get_typestore(Stores.ROS2_JAZZY)
        with self._refusing():
            _check_files(Path(self.path))
            self._reader = Reader(self.path)
            self._reader.open()
        try:
            self._check_counts()
            self.topics: dict[str, Topic] = {}
            for name in sorted({one.topic for one in self._reader.connections}):
                connections = [one for one in self._reader.connections if one.topic == name]
                types = ", ".join(sorted({one.msgtype for one in connections}))
                self.topics[name] = Topic(types, sum(one.msgcount for one in connections))
            self.begin_ns: int = self._reader.start_time
            self.end_ns: int = self._reader.end_time - 1
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the files."""
        self._reader.close()

    def of_types(self, types: Sequence[str]) -> list[str]:
        """Return the topics with messages of one of these types."""
        return [name for name, one in self.topics.items() if one.messages and one.type in types]

    def listed(self, names: Sequence[str]) -> str:
        """Return topics with their types and counts as text."""
        shown = [f"{name} ({self.topics[name].type}, {self.topics[name].messages})" for name in names]
        return ", ".join(shown) or "none"

    def choose(self, types: Sequence[str], named: str | None, option: str) -> str:
        """Return the topic with messages of one of these types, the only one or the named one.

        Raises
        ------
        BadRequest
            Several topics fit, or the named one is missing, of another type or empty.
        MapMissing
            No topic fits.
        """
        fitting, wanted = self.of_types(types), " or ".join(types)
        if named in fitting:
            return named
        if named is not None:
            found = self.topics.get(named)
            if found is None:
                wrong = f"no topic {named}"
            elif found.type in types:
                wrong = f"topic {named} has no messages"
            else:
                wrong = f"topic {named} is {found.type}, not {wanted}"
            raise BadRequest(f"{self.path}: {wrong}", hint=f"for {option} it has {self.listed(fitting)}")
        if not fitting:
            raise MapMissing(
                f"{self.path}: no topic has messages of {wanted}; it has {self.listed([*self.topics])}"
            )
        if len(fitting) > 1:
            raise BadRequest(
                f"{self.path}: several topics fit: {self.listed(fitting)}",
                hint=f"choose one: {option} {fitting[0]}",
            )
        return fitting[0]

    def messages(
        self, topic: str, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Yield the messages of a topic with the times of their recording, ordered by these.

        Parameters
        ----------
        topic
        start_ns, stop_ns
            The first time, and the time after the last one; by default all.

        Raises
        ------
        MapDataError
            The bag is damaged, has no message where it counts some, or messages are compressed, or serialized
            in another way than CDR.
        """
        chosen = [one for one in self._reader.connections if one.topic == topic]
        for one in chosen:
            if (used := one.ext.serialization_format) != _SERIALIZED:  # type: ignore[union-attr]
                raise MapDataError(
                    f"{self.path}: messages of {topic} are serialized as {used}, not {_SERIALIZED}"
                )
        if not chosen:
            return
        coming = self._reader.messages(chosen, start_ns, stop_ns)
        empty = True
        while True:
            with self._refusing(f", topic {topic}"):
                found = next(coming, None)
                if found is None:
                    break
                connection, time_ns, raw = found
                if raw[:4] == _ZSTD:
                    raise MapDataError(
                        f"{self.path}: messages of {topic} are compressed, each for itself",
                        hint=f"give the directory, whose {_METADATA} says so",
                    )
                message = self._types.deserialize_cdr(raw, connection.msgtype)
            empty = False
            yield time_ns, message
        if empty and start_ns is None and stop_ns is None and self.topics[topic].messages:
            raise MapDataError(f"{self.path}: {self.topics[topic].messages} messages of {topic} are missing")

    def _check_counts(self) -> None:
        """Compare the count in ``metadata.yaml`` with those of the files."""
        storages = getattr(self._reader.storage, "storages", None)
        if storages is None:
            return
        found = sum(one.metadata.message_count for one in storages)
        if found != self._reader.message_count:
            raise MapDataError(
                f"{self.path}: {_METADATA} counts {self._reader.message_count} messages, the files"
                f" have {found}",
                hint=f"`ros2 bag reindex {self.path}` counts them again",
            )

    @contextlib.contextmanager
    def _refusing(self, place: str = "") -> Iterator[None]:
        """Convert whatever rosbags raises on a damaged or foreign bag."""
        try:
            yield
        except ShmmapError:
            raise
        except OSError as error:
            raise MapDataError(f"{self.path}{place}: cannot be read: {error.strerror or error}") from error
        except Exception as error:  # of sqlite, decompressors, YAML, struct, ... by the damage
            said = (str(error).splitlines() or [""])[0].strip("' ")[:200] or type(error).__name__
            hint = _RECOVER.get(Path(self.path).suffix.lower(), _REINDEX).format(self.path)
            raise MapDataError(f"{self.path}{place}: cannot be read as a bag: {said}", hint=hint) from error


def _check_files(path: Path) -> None:
    """Refuse what rosbags cannot open, or would open incompletely without saying so.

    Raises
    ------
    MapMissing
        There is no such file.
    MapDataError
        A file is missing beside it, or has to be converted first.
    """
    name = str(path)
    if not path.exists():
        raise MapMissing(f"there is no file {name}")
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    if path.suffix.lower() == ".bag" and not path.is_dir():
        raise MapDataError(
            f"{name}: a bag of ROS 1, not of ROS 2",
            hint=f"`rosbags-convert --src {name} --dst DIR` makes one",
        )
    if not path.is_dir() and path.suffix.lower() == ".zstd":
        raise MapDataError(
            f"{name}: compressed as a whole", hint=f"give its directory, or `zstd -d {name}` and the result"
        )
    if path.is_dir() and not (path / _METADATA).exists():
        parts = [str(file) for file in files if file.name.lower().endswith(_FILES)]
        other = f", or give the file {parts[0]}" if parts else ""
        raise MapDataError(
            f"{name}: no {_METADATA}, which a recorder writes at its end",
            hint=f"`ros2 bag reindex {name}` writes it{other}",
        )
    for file in files:
        log = file.with_name(file.name + "-wal")
        if file.suffix.lower() == ".db3" and log.exists() and log.stat().st_size:
            raise MapDataError(
                f"{file}: messages are in {log.name}, and not in the file yet",
                hint=f"`sqlite3 {file} 'PRAGMA wal_checkpoint(TRUNCATE)'` moves them there",
            )
