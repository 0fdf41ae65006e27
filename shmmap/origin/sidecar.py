# SPDX-License-Identifier: Apache-2.0
"""A catalogue on disk, so that the daemon of a large map need not read it anew at every start.

The file lies in the cache directory and is only ever a copy: a missing, old or damaged one costs
time, nothing else.  It names what it was made from (the metadata file and every directory that was
listed, each with size, mtime, ctime and inode) and counts only while all of that is unchanged.  A
file rewritten in place changes no directory, so its stamp here may be old: whoever loads the cell
compares, and `load(fresh=True)` looks at every file.  Its layout is that of `shmmap.origin.catalogue_bytes`.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence

import msgspec
from xxhash import xxh3_64_hexdigest

from shmmap.errors import MapDataError
from shmmap.logfmt import log
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.catalogue_bytes import Source, read_catalogue, write_catalogue

__all__ = ["default_cache_directory", "load_sidecar", "save_sidecar", "sidecar_file"]

# File systems stamp files by the kernel's coarse clock, which ticks every 1 to 10 ms: a change right
# after a scan can leave a directory's stamp as it was.  Younger sources are not trusted to be done.
_SETTLED_NS = 20_000_000


def default_cache_directory() -> str:
    """``$CACHE_DIRECTORY`` (set by systemd), else ``$XDG_CACHE_HOME/shmmap``, else ``~/.cache/shmmap``."""
    given = os.environ.get("CACHE_DIRECTORY", "").split(":")[0]
    if given:
        return given
    home = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(home):
        home = os.path.expanduser("~/.cache")
    return os.path.join(home, "shmmap")


def sidecar_file(cache_dir: str, key: str) -> str:
    """Where the catalogue of the map that ``key`` describes is kept."""
    return os.path.join(cache_dir, xxh3_64_hexdigest(os.fsencode(key)) + ".catalogue")


def load_sidecar(path: str, key: str, at: Callable[[str], str] = str) -> Catalogue | None:
    """Catalogue from the sidecar, or None when there is none, its sources changed, or it is damaged.

    ``at`` says where to find what a source's path names.
    """
    try:
        with open(path, "rb") as file:
            header, catalogue = read_catalogue(file, os.fstat(file.fileno()).st_size)
        return catalogue if header.key == key and _unchanged(header.sources, at) else None
    except FileNotFoundError:
        return None
    except OSError as error:
        log.warning("catalogue cache cannot be read", path=path, error=error.strerror)
        return None
    except (ValueError, MapDataError, msgspec.MsgspecError) as error:
        log.warning("damaged catalogue cache ignored", path=path, error=error)
        return None


def _unchanged(sources: Sequence[Source], at: Callable[[str], str]) -> bool:
    try:
        return all(Source.of(source.path, os.stat(at(source.path))) == source for source in sources)
    except OSError:
        return False


def save_sidecar(
    path: str, key: str, sources: Sequence[Source], catalogue: Catalogue, scanned_ns: int
) -> bool:
    """Write the sidecar in one step; False (and a line in the log) if that was not possible.

    ``sources`` were looked at before the scan, which began at ``scanned_ns`` (`time.time_ns`).
    """
    newest = max(max(source.mtime_ns, source.ctime_ns) for source in sources)
    if newest > scanned_ns - _SETTLED_NS:
        return False
    try:
        os.makedirs(os.path.dirname(path), mode=0o700, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=os.path.dirname(path), prefix=".catalogue-", delete=False
        ) as file:
            try:
                write_catalogue(file, key, sources, catalogue)
                file.flush()
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                raise
    except OSError as error:
        log.warning("catalogue not cached", path=path, error=error.strerror)
        return False
    return True
