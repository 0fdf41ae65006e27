# SPDX-License-Identifier: Apache-2.0
"""Options of the verbs that read a whole map, or work on a published one."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from shmmap.cli.options import add_cloud_options, at_least
from shmmap.cli.screens.output import print_line
from shmmap.cli.screens.work_progress import StageProgress
from shmmap.errors import BadRequest, ConfigError
from shmmap.lazy_imports import TO_SIGN, needed_packages

if TYPE_CHECKING:
    from shmmap.cli import json_output
    from shmmap.dividing.served_cloud import DividedCloud
    from shmmap.origin.map_directory import MapDirectory
    from shmmap.origin.remote.store import Store
    from shmmap.origin.remote.verify_apart import Verified
    from shmmap.prepare.run import Failure
    from shmmap.publishing.signing import MapSigner

_SHOWN_FAILURES: Final = 20


def add_map_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for reading a map, and the number of processes."""
    parser.add_argument("--metadata", metavar="FILE", help="metadata YAML, if it is not with the map")
    parser.add_argument(
        "--strict", action="store_true", help="accept only what Autoware's own loader accepts"
    )
    add_cloud_options(parser)
    parser.add_argument(
        "--workers",
        metavar="N",
        type=at_least(0),
        default=0,
        help="number of processes (default: one for each core)",
    )


def refuse_map_options(args: argparse.Namespace, what: str, others: Sequence[str] = ()) -> None:
    """Refuse ``others`` and options for reading files where no file is read; ``what`` is the reason."""
    for option in ("metadata", "strict", "unit", "vertical_unit", "drop_noise", *others):
        if getattr(args, option):
            raise BadRequest(f"--{option.replace('_', '-')} does not go with {what}")


def origin_at(args: argparse.Namespace, cache_dir: str) -> MapDirectory | DividedCloud:
    """Open the map at ``args.map_path`` with the options for reading it."""
    from shmmap.dividing.served_cloud import find_origin

    return find_origin(
        args.map_path,
        metadata=args.metadata or "",
        strict=args.strict,
        cache_dir=cache_dir,
        unit=args.unit or "",
        vertical_unit=args.vertical_unit or "",
        drop_noise=args.drop_noise,
    )


def cache_directory(args: argparse.Namespace) -> str:
    """Return the cache directory from the options."""
    from shmmap.origin.catalogue_bytes import default_cache_directory

    return os.path.abspath(args.cache_dir or default_cache_directory())


def progress_on_stderr(args: argparse.Namespace, unit: str = "cells") -> StageProgress:
    """Return the progress display, which shows nothing with ``--quiet`` or ``--json``."""
    return StageProgress(quiet=args.quiet or args.json, unit=unit, scale=1.0)


def worker_count(args: argparse.Namespace) -> int:
    """Return the number of processes from the options."""
    return args.workers or len(os.sched_getaffinity(0))


def failure_rows(failures: Sequence[Failure]) -> list[json_output.Failure]:
    """Return the JSON form of layers that could not be made."""
    from shmmap.cli import json_output

    return [json_output.Failure(one.cell_id, one.layer, one.message) for one in failures]


def print_failures(failures: Sequence[Failure]) -> None:
    """Print the layers that could not be made; only the first if there are many."""
    for failure in failures[:_SHOWN_FAILURES]:
        print_line(f"failed: {failure.cell_id} ({failure.layer}): {failure.message}")
    if len(failures) > _SHOWN_FAILURES:
        print_line(f"failed: {len(failures) - _SHOWN_FAILURES:,} more")


URL_HELP = "where the map is published: s3://, gs://, az://, https://, file://, or a directory"


def add_store_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for reaching a store, besides its URL."""
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


def add_sole_publisher_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for stores that do not write on conditions."""
    parser.add_argument(
        "--sole-publisher",
        action="store_true",
        help="publish although the store may not write on conditions: of two programs that publish there at"
        " once, one may lose its version without a word",
    )


def store_at(url: str, args: argparse.Namespace) -> Store:
    """Open the store at a URL with the options."""
    with needed_packages("a published map"):
        from shmmap.origin.remote.opened_store import open_store
        from shmmap.origin.remote.store import may_be_plain

        plain = may_be_plain(url, insecure_http=args.insecure_http, trust=getattr(args, "trust", None))
        return open_store(
            url,
            insecure_http=plain,
            instance_credentials=args.instance_credentials,
            sole_publisher=getattr(args, "sole_publisher", False),
        )


def add_sign_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the keys of a signed map."""
    parser.add_argument("--sign", metavar="KEYDIR", help="sign with the keys in this directory")


def signer_at(store: Store, args: argparse.Namespace, *, make_keys: bool = False) -> MapSigner | None:
    """Return the signer of a map from the options; None if it is not signed."""
    if args.sign is None:
        return None
    with needed_packages("a signed map", together=TO_SIGN):
        from shmmap.publishing.signing import MapSigner

    return MapSigner(store, args.sign, make_keys=make_keys)


def add_trust_option(group: argparse._ActionsContainer) -> None:
    """Add the option for the root of trust."""
    group.add_argument(
        "--trust", metavar="ROOT.json", help="take only what is signed under this root, and nothing older"
    )


def verified_at(store: Store, args: argparse.Namespace) -> Verified | None:
    """Return the current version, verified by the root of trust; None if no root was given."""
    if args.trust is None:
        return None
    from shmmap.live_settings import state_directory
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
