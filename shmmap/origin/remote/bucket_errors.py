# SPDX-License-Identifier: Apache-2.0
"""What an error of obstore means; only parts of its text are repeated, which may contain a signed URL."""

from __future__ import annotations

import re
from typing import Final

from shmmap.errors import MapMissing, Offline, ShmmapError
from shmmap.lazy_imports import FOR_REMOTE, needed_packages
from shmmap.origin.remote.store import NoBucket, NoTag, StoreRefused
from shmmap.origin.remote.transport import (
    AGAIN,
    BETWEEN,
    CREDENTIALS,
    NO_TLS,
    PROXY,
    is_panic,
    status_hint,
    unasked_304,
)
from shmmap.origin.remote.unread_answers import MAX_UNREAD_BYTES, UNREAD

with needed_packages("a map in a bucket", together=FOR_REMOTE):
    from obstore import exceptions

NOWHERE: Final = "255.255.255.255:1"
"""Where redirects to other hosts are sent: as obstore follows them all, its proxy for all hosts but the
store's is an address at which the kernel refuses every connection."""
_STATUS: Final = re.compile(r"\b([45]\d\d)\b (?:[A-Z][A-Za-z ]+)|status(?: code)?:? ([1-9]\d\d)")
_MOVED: Final = re.compile(r"status code: 30[12378]\b")
_UNASKED: Final = re.compile(r"status code: 304\b")
_SILENT: Final = "is the network up, and the address right? (s3:// has it of AWS_ENDPOINT_URL and AWS_REGION)"
_REGION: Final = "is AWS_REGION that of the bucket?"
_ACCOUNT: Final = "are the account's and the bucket's names right?"
_CERTIFICATE: Final = "SSL_CERT_FILE names further authorities; is the clock right?"
_ADDRESS: Final = "is the address that of a store, and is there such a bucket?"
_PANIC: Final = "this is a defect: please report it, with what the log says before"
_TRUE_NAMES: Final = (
    (
        "Content-Length Header missing",
        "its answer has no length",
        f"is it sent in chunks? {BETWEEN}",
    ),
    (
        "invalid list response",
        "its answer is no listing of objects",
        "is it a page, or compressed?",
    ),
    ("list response body", "its listing ended early", BETWEEN),
    ("InvalidMessage(", "the answer is no TLS", NO_TLS),
    ("ProxyAuthRequired", "the proxy wants a user and a password", PROXY),
    ("TunnelUn", "the proxy does not connect to it", PROXY),
    ("Parse(", "the answer is no HTTP", "is the address right, and its port?"),
    ("source: Header {", "its answer has a header that cannot be read", BETWEEN),
    ("source: Metadata {", "its answer has a header that cannot be read", BETWEEN),
    ("source: InvalidContentType {", "its answer has a header that cannot be read", BETWEEN),
    ("invalid utf-8 sequence", "refused, with an error that is no UTF-8", BETWEEN),
)
"""What is in the text of an obstore error, what it means, and a hint."""
_ELSEWHERE: Final = "the bucket is in another region"
_CODE: Final = re.compile(r"<Code>(\w+)</Code>")
_REASONS: Final = {
    "ExpiredToken": "the credentials have expired",
    "TokenRefreshRequired": "the credentials have expired",
    "InvalidAccessKeyId": "the store knows no such access key",
    "InvalidToken": "the session token is not valid",
    "SignatureDoesNotMatch": "the secret does not belong to the access key",
    "RequestTimeTooSkewed": "this machine's clock differs from the store's",
    "AccessDenied": "no permission",
    "AllAccessDisabled": "the bucket's owner has disabled it",
    "AccountProblem": "the account is closed or not paid for",
    "InvalidBucketName": "no bucket can have this name",
    "PermanentRedirect": _ELSEWHERE,
    "TemporaryRedirect": _ELSEWHERE,
    "AuthorizationHeaderMalformed": _ELSEWHERE,
    "IllegalLocationConstraintException": _ELSEWHERE,
    "AuthenticationFailed": "the account's key or token is not valid",
    "AuthorizationFailure": "no permission",
    "AuthorizationPermissionMismatch": "no permission",
    "InsufficientAccountPermissions": "no permission",
    "NoAuthenticationInformation": "it takes no requests without credentials",
    "PublicAccessNotPermitted": "it takes no requests without credentials",
    "ContainerBeingDeleted": "the container is being deleted",
    "AccountIsDisabled": "the account is closed or not paid for",
}
"""Meanings of Amazon's error codes, which Google and others use, too, and of Azure's."""
_HINTS: Final = {
    _ELSEWHERE: _REGION,
    "no permission": "may this account use this bucket? Its policy, or the account's roles, say so",
    "the container is being deleted": AGAIN,
}
"""Hints for reasons that are none of the credentials."""
_NO_BUCKET: Final = re.compile(
    r"<Code>(NoSuchBucket|ContainerNotFound)</Code>|The specified (bucket|container) does not exist"
)
"""In the answers of Amazon and Google (XML and JSON), and of Azure."""
_NO_TAG: Final = "ETag Header missing"
_TEXT_BYTES: Final = 64 << 10


def _text(error: BaseException) -> str:
    """Return an error's text, without the middle of a long one."""
    text = str(error)
    return text if len(text) < 2 * _TEXT_BYTES else f"{text[:_TEXT_BYTES]} {text[-_TEXT_BYTES:]}"


def refuse_unread(name: str, error: BaseException, ended: int) -> None:
    """Raise that an answer was ended, if since ``ended`` one was, and the error is that of such an answer."""
    if UNREAD.ended > ended and ("response body" in _text(error) or len(str(error)) > MAX_UNREAD_BYTES):
        raise StoreRefused(
            f"{name}: its answer, which is no object, has more than {MAX_UNREAD_BYTES >> 20} MiB",
            hint=BETWEEN,
        )


def missing(name: str, error: BaseException) -> ShmmapError:
    """Return our error for a status 404."""
    if _NO_BUCKET.search(_text(error)):
        return NoBucket(f"{name}: there is no such bucket", status=404)
    return MapMissing(f"{name} is not there")


def failure(name: str, error: BaseException) -> Offline:
    """Return our error for one of obstore; only parts of its text without secrets are repeated."""
    text = _text(error)
    if is_panic(error):
        return Offline(f"{name}: the request has made the package obstore fail", hint=_PANIC)
    if isinstance(error, exceptions.PermissionDeniedError | exceptions.UnauthenticatedError):
        why = _reason(text)
        return StoreRefused(
            f"{name}: refused, {why or 'no permission'}",
            hint=_HINTS.get(why, CREDENTIALS),
            of_credentials=True,
            status=403,
        )
    return _out_of_reach(name, text)


def _out_of_reach(name: str, text: str) -> Offline:
    """Return our error for the text of an obstore error; only parts without secrets are repeated."""
    if _NO_BUCKET.search(text):
        return NoBucket(f"{name}: there is no such bucket", status=404)
    found = _STATUS.search(text)
    status = int(found[1] or found[2]) if found is not None else 0
    hint = status_hint(status, _ADDRESS)
    elsewhere = _REGION if name.startswith("s3:") else _ACCOUNT
    if why := _reason(text):
        hint = _HINTS.get(why, CREDENTIALS)
        return StoreRefused(f"{name}: refused, {why}", hint=hint, of_credentials=True, status=status)
    if NOWHERE in text or _MOVED.search(text):
        return StoreRefused(f"{name}: refused, it is somewhere else", hint=elsewhere)
    if _UNASKED.search(text):
        return unasked_304(name)
    if _NO_TAG in text:
        return NoTag(f"{name}: its answer has no ETag", hint=BETWEEN)
    for part, says, its_hint in _TRUE_NAMES:
        if part in text:
            return StoreRefused(f"{name}: {says}", hint=its_hint)
    if status:
        return StoreRefused(f"{name}: refused (status {status})", hint=hint, status=status)
    if "redirect" in text.lower():
        return StoreRefused(f"{name}: refused, it is somewhere else", hint=elsewhere)
    if "certificate" in text.lower():
        return StoreRefused(f"{name}: the server's certificate is not accepted", hint=_CERTIFICATE)
    in_time = " in time" if "kind: Timeout" in text else ""
    return Offline(f"{name}: no answer{in_time}", hint=_SILENT)


def _reason(text: str) -> str:
    """Return the reason of a store's refusal if the text has a known error code; else an empty string."""
    found = _CODE.search(text)
    return _REASONS.get(found[1], "") if found is not None else ""
