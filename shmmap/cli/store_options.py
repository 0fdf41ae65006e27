# SPDX-License-Identifier: Apache-2.0
"""Options of the verbs that work on published maps."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shmmap.origin.remote.store import Store
    from shmmap.origin.remote.verify_apart import Verified
    from shmmap.publishing.signing import MapSigner

__all__ = [
    "URL_HELP",
    "add_sign_option",
    "add_store_options",
    "add_trust_option",
    "signer_at",
    "store_at",
    "verified_at",
]

URL_HELP = "where the map is published: s3://, gs://, az://, https://, file://, or a directory"


def add_store_options(parser: argparse.ArgumentParser) -> None:
    """Add how a store is reached, besides its URL."""
    group = parser.add_argument_group("the store")
    group.add_argument(
        "--insecure-http",
        action="store_true",
        help="accept plain http:// from other machines, although it can be read and changed in transit",
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
        from shmmap.origin.remote.store import may_be_plain

        plain = may_be_plain(url, insecure_http=args.insecure_http, trust=getattr(args, "trust", None))
        return open_store(url, insecure_http=plain, instance_credentials=args.instance_credentials)


def add_sign_option(parser: argparse.ArgumentParser) -> None:
    """Add where the keys of a signed map are."""
    parser.add_argument("--sign", metavar="KEYDIR", help="sign with the keys in this directory")


def signer_at(store: Store, args: argparse.Namespace, *, make_keys: bool = False) -> MapSigner | None:
    """Return what signs a map, as the options say; None: it is not signed."""
    from shmmap.optional_packages import TO_SIGN, needed_packages

    if args.sign is None:
        return None
    with needed_packages("a signed map", together=TO_SIGN):
        from shmmap.publishing.signing import MapSigner

    return MapSigner(store, args.sign, make_keys=make_keys)


def add_trust_option(group: argparse._ActionsContainer) -> None:
    """Add the root of trust."""
    group.add_argument(
        "--trust", metavar="ROOT.json", help="take only what is signed under this root, and nothing older"
    )


def verified_at(store: Store, args: argparse.Namespace) -> Verified | None:
    """Return the version that is signed under the root of trust; None: none was given."""
    import os

    if args.trust is None:
        return None
    from shmmap.daemon.config_live import state_directory
    from shmmap.errors import ConfigError
    from shmmap.origin.remote.store import may_be_plain
    from shmmap.origin.remote.verify_apart import VerifySettings, verify_apart

    state_dir = state_directory("")
    if not state_dir:
        raise ConfigError("there is no directory to keep what was verified", hint="set XDG_STATE_HOME")
    return verify_apart(
        VerifySettings(
            store.url,
            os.path.abspath(args.trust),
            state_dir,
            may_be_plain(store.url, insecure_http=args.insecure_http, trust=args.trust),
            args.instance_credentials,
        )
    )
