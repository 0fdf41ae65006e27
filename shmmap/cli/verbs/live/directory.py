# SPDX-License-Identifier: Apache-2.0
"""Which live map is meant: the directory that has its files."""

from __future__ import annotations

import argparse
import os

__all__ = ["add_directory", "directory_from"]


def add_directory(parser: argparse.ArgumentParser) -> None:
    """Add ``DIR``."""
    parser.add_argument("directory", metavar="DIR", help="the directory of the live map")


def directory_from(args: argparse.Namespace) -> str:
    """Return its path."""
    directory: str = args.directory
    return os.path.abspath(directory)
