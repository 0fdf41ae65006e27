# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo``, of a small town and two processes: ``python -m tests.support.small_demo``, as the verb.

Everything that the demonstration starts and does, in a few seconds.
"""

from __future__ import annotations

import functools
import sys
from typing import Final

from shmmap import cli
from shmmap.demo import demo_town

__all__ = ["SMALL"]

SMALL: Final = demo_town.DemoSettings(
    blocks=(3, 2),
    density=4.0,
    radius=60.0,
    length=20.0,
    onward=12,
    localized=10.0,
    counts=(1, 2),
    many=2,
)


if __name__ == "__main__":
    demo_town.DemoSettings = functools.partial(  # type: ignore[misc, assignment]
        demo_town.DemoSettings, **{name: getattr(SMALL, name) for name in SMALL.__slots__}
    )
    sys.exit(cli.main(["demo", *sys.argv[1:]]))
