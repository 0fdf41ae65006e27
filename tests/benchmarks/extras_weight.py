# SPDX-License-Identifier: Apache-2.0
"""What each extra adds to the disk beside an install without Open3D, by the files of the installed packages.

    python -m tests.benchmarks.extras_weight

in an environment with the extras; it names those that are not installed.  Sizes are those of this machine's
wheels, compiled modules included.
"""

from __future__ import annotations

import argparse
import importlib.metadata
from collections.abc import Iterable
from pathlib import Path

from packaging.requirements import Requirement

NOT_FOR_USERS = {"test", "dev", "docs"}
HEAVY = {"open3d", "open3d-cpu"}


def extras() -> list[str]:
    """Return the extras that users install."""
    found = importlib.metadata.metadata("shmmap").get_all("Provides-Extra") or []
    return sorted(set(found) - NOT_FOR_USERS)


def needed(name: str, chosen: Iterable[str] = ()) -> set[str]:
    """Return the names of the packages that a package with some of its extras needs, itself included.

    Raises
    ------
    importlib.metadata.PackageNotFoundError
        One of them is not installed.
    """
    found: set[str] = set()
    waiting = [(name, tuple(chosen))]
    seen: set[tuple[str, tuple[str, ...]]] = set()
    while waiting:
        one = waiting.pop()
        if one in seen:
            continue
        seen.add(one)
        found.add(one[0])
        for text in importlib.metadata.requires(one[0]) or []:
            requirement = Requirement(text)
            wanted = requirement.marker is None or any(
                requirement.marker.evaluate({"extra": extra}) for extra in ("", *one[1])
            )
            called = requirement.name.lower().replace("_", "-")
            if wanted and called not in HEAVY:
                waiting.append((called, tuple(sorted(requirement.extras))))
    return found


def bytes_of(name: str) -> int:
    """Return the size of a package's installed files."""
    files = importlib.metadata.files(name) or []
    paths = (Path(str(one.locate())) for one in files)
    return sum(path.stat().st_size for path in paths if path.is_file())


def main() -> None:
    """Print a line for each extra."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args()
    base = needed("shmmap")
    for extra in extras():
        try:
            added = needed("shmmap", [extra]) - base
        except importlib.metadata.PackageNotFoundError as missing:
            print(f"{extra:8} {missing.name} is not installed")
            continue
        total = sum(map(bytes_of, added))
        print(f"{extra:8} {total / 1e6:6.1f} MB, {len(added)} packages: {' '.join(sorted(added))}")


if __name__ == "__main__":
    main()
