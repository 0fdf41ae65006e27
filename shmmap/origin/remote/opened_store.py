# SPDX-License-Identifier: Apache-2.0
"""Opens the store at a URL."""

from __future__ import annotations

from shmmap.origin.remote.directory_store import DirectoryStore
from shmmap.origin.remote.store import LONG_RUN, Store, Timeouts, read_url

__all__ = ["open_store"]


def open_store(
    url: str,
    *,
    timeouts: Timeouts = LONG_RUN,
    insecure_http: bool = False,
    instance_credentials: bool = False,
) -> Store:
    """Return the store at a URL or in a directory; nothing is asked of it yet.

    Parameters
    ----------
    insecure_http
        Take plain ``http://`` beyond this machine.
    instance_credentials
        Ask the cloud's metadata address for credentials where none are given.

    Raises
    ------
    BadRequest
        As `read_url`; or plain ``http://`` beyond this machine.
    ConfigError
        The credentials given cannot be used.
    PackageMissing
        Without obstore.
    """
    where = read_url(url)
    if where.scheme == "file":
        return DirectoryStore(where.path)
    from shmmap.origin.remote.bucket_store import BucketStore

    return BucketStore(
        where, timeouts=timeouts, insecure_http=insecure_http, instance_credentials=instance_credentials
    )
