# SPDX-License-Identifier: Apache-2.0
"""Build the documentation site: ``python .github/site OUT``; the packages are those of the extra ``docs``.

A warning of Sphinx is an error, and so is a link or an anchor that leads nowhere, or a page that loads
anything from another host.  Nothing is fetched.  It needs a checkout: git says what belongs to it.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from site_checks import check_searches, check_site
from site_contents import HERE, SEARCHES
from site_reference import add_reference
from site_staging import stage
from sphinx.cmd.build import main as sphinx_build

ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """Build into the directory that is named; return the exit code."""
    if len(sys.argv) != 2:
        print("usage: python .github/site OUT", file=sys.stderr)
        return 2
    out = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory(prefix="shmmap-site-") as work:
        tree = stage(ROOT, Path(work) / "pages")
        add_reference(tree)
        shutil.rmtree(out, ignore_errors=True)
        strict = ["-q", "-W", "--keep-going", "-n"]
        places = ["-c", str(ROOT / HERE), "-d", f"{work}/doctrees", str(tree.out), str(out)]
        failed: int = sphinx_build([*strict, "-j", "2", *places])
        if failed:
            return failed
    faults = check_site(out) + check_searches(out, SEARCHES)
    for line in faults:
        print(line, file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
