# SPDX-License-Identifier: Apache-2.0
"""Options of the verbs that work on published maps."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shmmap.origin.remote.store import Store

__all__ = ["URL_HELP", "add_store_options", "store_at"]

URL_HELP = "where the map is published: s3://, gs://, az://, https://, file://, or a directory"


def add_store_options(parser: argparse.ArgumentParser) -> None:
    """Add what is said about a store besides its URL."""
    group = parser.add_argument_group("the store")
    group.add_argument(
        "--insecure-http",
        action="store_true",
        help="take plain http:// from beyond this machine: it can be read and changed on its way",
    )
    group.add_argument(
        "--instance-credentials",
        action="store_true",
        help="ask the cloud's metadata address for credentials if none are given",
    )


def store_at(url: str, args: argparse.Namespace) -> Store:
    """Return the store at a URL, opened as the options say."""
    from shmmap.optional_packages import needed_packages

    with needed_packages("a published map"):
        from shmmap.origin.remote.opened_store import open_store

        return open_store(
            url, insecure_http=args.insecure_http, instance_credentials=args.instance_credentials
        )
