# SPDX-License-Identifier: Apache-2.0
"""``shmmap completion SHELL``: print the script that completes verbs and options in a shell.

The scripts are files of this package, so that no completion starts Python; a test writes and compares them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Final

from shmmap.cli.options import Subparsers, add_verb

SHELLS: Final = ("bash", "zsh", "fish")

_EPILOG = """\
For this shell alone:
  bash   source <(shmmap completion bash)
  zsh    eval "$(shmmap completion zsh)", after compinit
  fish   shmmap completion fish | source
For all later ones:
  bash   shmmap completion bash > ~/.local/share/bash-completion/completions/shmmap
  zsh    shmmap completion zsh > DIR/_shmmap, a DIR of $fpath
  fish   shmmap completion fish > ~/.config/fish/completions/shmmap.fish
Exit code: 0."""


def add_completion(subparsers: Subparsers) -> None:
    """Add the verb ``completion``."""
    parser = add_verb(
        subparsers,
        "completion",
        run_completion,
        help="a script that completes verbs and options in a shell",
        description="Print a script that completes verbs, options and files of `shmmap`.",
        epilog=_EPILOG,
    )
    parser.add_argument(
        "shell", metavar="SHELL", choices=SHELLS, help=f"{', '.join(SHELLS[:-1])} or {SHELLS[-1]}"
    )


def script_of(shell: str) -> Path:
    """Return the file of a shell's script."""
    return Path(__file__).parents[2] / "completion" / f"shmmap.{shell}"


def run_completion(args: argparse.Namespace) -> int:
    """Print the script."""
    sys.stdout.write(script_of(args.shell).read_text(encoding="utf-8"))
    return 0
