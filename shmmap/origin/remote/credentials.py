# SPDX-License-Identifier: Apache-2.0
"""Credentials for buckets: from the environment, the service manager or a profile.

obstore reads the environment itself.  Without credentials it would ask the cloud's metadata address.  On a
vehicle, nothing or an unknown machine answers there, so this is done only if it is configured.
Credentials are checked when they are read; a daemon whose file of credentials is spoilt while it runs names
that as the reason why the store is out of reach.
"""

from __future__ import annotations

import configparser
import contextlib
import os
import re
from collections.abc import Callable, Mapping
from datetime import datetime, timedelta, timezone
from typing import Any, Final, NamedTuple

from shmmap.errors import ConfigError
from shmmap.origin.remote.store import BUCKET_SCHEMES

_DIRECTORY: Final = "CREDENTIALS_DIRECTORY"  # systemd.exec(5), LoadCredential=
AWS_FILE: Final = "shmmap.aws"
GOOGLE_FILE: Final = "shmmap.google"
AZURE_FILE: Final = "shmmap.azure"
_REFUSED_KEYS: Final = {
    "sso_session": "single sign-on",
    "sso_start_url": "single sign-on",
    "sso_account_id": "single sign-on",
    "role_arn": "an assumed role",
    "credential_process": "a program",
    "credential_source": "an assumed role",
    "web_identity_token_file": "a web identity",
}
_EXPORT: Final = (
    "export them as AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_SESSION_TOKEN:"
    ' eval "$(aws configure export-credentials --format env)"'
)
_ASKED_OF_OTHERS: Final = (
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
)
_GOOGLE: Final = (
    "GOOGLE_APPLICATION_CREDENTIALS",
    "GOOGLE_SERVICE_ACCOUNT",
    "GOOGLE_SERVICE_ACCOUNT_KEY",
    "GOOGLE_SERVICE_ACCOUNT_PATH",
    "SERVICE_ACCOUNT",
)
_IN_REQUESTS: Final = re.compile(
    r"(AWS|AZURE|GOOGLE)_\w*(KEY|SECRET|TOKEN|SAS|REGION|ENDPOINT|ACCOUNT|CLIENT|TENANT|AUTHORITY|BUCKET|ROLE"
    r"|SSE|ENCRYPTION|URI|URL)\w*"
)
"""Variables whose values obstore puts into requests."""
_MANY_LINES: Final = "GOOGLE_SERVICE_ACCOUNT_KEY"  # a JSON text
_TOKEN_FILES: Final = (
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_CONTAINER_AUTHORIZATION_TOKEN_FILE",
    "AZURE_FEDERATED_TOKEN_FILE",
)
_GCLOUD: Final = "~/.config/gcloud/application_default_credentials.json"
_AGAIN_AFTER: Final = timedelta(minutes=5)
_TRUE: Final = ("1", "true", "yes", "on")

_NAMES: Final = {"\n": "a line break", "\r": "a line break", "\t": "a tabulator"}
_UNSIGNED: Final = "nowhere: requests are not signed"
_INSTANCE: Final = "the cloud's metadata address (instance_credentials)"
_NO_SIGNATURE: Final = {"skip_signature": True}


class Credentials(NamedTuple):
    """Credentials for one kind of store.

    Attributes
    ----------
    settings
        Settings for obstore; `_NO_SIGNATURE` is among them if there are no credentials.
    source
        Where the credentials are read from, for people; it never contains them.
    provider
        Returns the keys, if they are not among the settings.
    """

    settings: dict[str, Any]
    source: str
    provider: Callable[[], dict[str, Any]] | None = None


def find_credentials(scheme: str, environment: Mapping[str, str], *, instance: bool = False) -> Credentials:
    """Find the credentials for a bucket.

    Raises
    ------
    ConfigError
        A profile's credentials are of an unsupported kind, or incomplete, or a file of them is malformed, or
        a value contains a character that a request cannot contain.
    """
    environment = {**environment, **clean_variables(environment)}
    for name in _TOKEN_FILES:
        if path := environment.get(name):
            with contextlib.suppress(OSError, UnicodeDecodeError), open(path, encoding="utf-8") as file:
                _clean(file.read(), origin=path)
    find = {"s3": _s3_credentials, "gs": _google_credentials, "az": _azure_credentials}[scheme]
    return find(environment, instance)


def clean_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables for requests that have white space around their values, without it.

    Raises
    ------
    ConfigError
        A value contains a character that a request cannot contain, such as a line break in its middle.
    """
    changed = {}
    for name, value in environment.items():
        if _IN_REQUESTS.fullmatch(name) and name != _MANY_LINES:
            clean = _clean(value, key=name, origin="environment")
            if clean != value:
                changed[name] = clean
    return changed


def _clean(value: str, *, key: str = "", origin: str) -> str:
    """Return a value without white space around it; refuse what no header of a request can contain."""
    clean = value.strip()
    for at, character in enumerate(clean):
        if not (character.isascii() and character.isprintable()):
            raise ConfigError(
                f"{key or origin} has {_NAMES.get(character, f'the character U+{ord(character):04X}')} after"
                f" its first {at} characters, which a request cannot contain",
                key=key,
                origin=origin,
                hint="was it copied whole, and nothing else with it?",
            )
    return clean


def credentials_source(scheme: str, environment: Mapping[str, str], *, instance: bool = False) -> str:
    """Return a description of where a store's credentials are read from; empty if it needs none.

    The description never contains the credentials.

    Raises
    ------
    ConfigError
        See `find_credentials`; also if the credentials have expired.
    """
    if scheme not in BUCKET_SCHEMES:
        return ""
    found = find_credentials(scheme, environment, instance=instance)
    expiry = environment.get("AWS_CREDENTIAL_EXPIRATION")
    if expiry and scheme == "s3" and "access_key_id" in found.settings:
        with contextlib.suppress(ValueError, TypeError):
            if datetime.fromisoformat(expiry.replace("Z", "+00:00")) <= datetime.now(timezone.utc):
                raise ConfigError(
                    f"the credentials in the environment expired at {expiry}",
                    key="AWS_CREDENTIAL_EXPIRATION",
                    origin="environment",
                    hint="export others, and start the daemon again",
                )
    return found.source


def _s3_credentials(environment: Mapping[str, str], instance: bool) -> Credentials:
    settings: dict[str, Any] = {}
    if not (environment.get("AWS_REGION") or environment.get("AWS_DEFAULT_REGION")):
        settings["region"] = _region(environment) or "us-east-1"
    if environment.get("AWS_SKIP_SIGNATURE", "").lower() in _TRUE:
        return Credentials({**settings, **_NO_SIGNATURE}, _UNSIGNED)
    key, secret = environment.get("AWS_ACCESS_KEY_ID"), environment.get("AWS_SECRET_ACCESS_KEY")
    if key and secret:
        settings |= {"access_key_id": key, "secret_access_key": secret}
        source = "the environment, AWS_ACCESS_KEY_ID"
        if token := environment.get("AWS_SESSION_TOKEN"):
            settings["session_token"] = token
            source += " with AWS_SESSION_TOKEN"
        return Credentials(settings, source)
    if key or secret:
        raise ConfigError("AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY are set only together")
    if not instance:
        for name in _ASKED_OF_OTHERS:
            if environment.get(name):
                raise ConfigError(
                    f"{name} is set: credentials would be asked of another server",
                    key=name,
                    origin="environment",
                    hint=f"allow it: --instance-credentials; or {_EXPORT}",
                )
    if (static := _static_keys(environment)) is not None:

        def provide() -> dict[str, Any]:
            found = _static_keys(environment)
            keys = found[0] if found is not None else {}
            return {**keys, "expires_at": datetime.now(timezone.utc) + _AGAIN_AFTER}

        return Credentials(settings, static[1], provide)
    if instance:
        return Credentials(settings, _INSTANCE)
    return Credentials({**settings, **_NO_SIGNATURE}, _UNSIGNED)


def _static_keys(environment: Mapping[str, str]) -> tuple[dict[str, Any], str] | None:
    """Return the keys in the service manager's or the shared credentials file, and their origin; or None."""
    profile = environment.get("AWS_PROFILE", "")
    files = [
        *_given_file(environment, AWS_FILE),
        environment.get("AWS_SHARED_CREDENTIALS_FILE") or os.path.expanduser("~/.aws/credentials"),
    ]
    for path in files:
        section = _section(path, profile or "default")
        if section is None:
            continue
        key, secret = section.get("aws_access_key_id"), section.get("aws_secret_access_key")
        if key and secret:
            token = section.get("aws_session_token", "")
            keys = {
                "access_key_id": _clean(key, key="aws_access_key_id", origin=path),
                "secret_access_key": _clean(secret, key="aws_secret_access_key", origin=path),
                "token": _clean(token, key="aws_session_token", origin=path) or None,
            }
            return keys, f"profile {profile or 'default'!r} of {_named(environment, path)}"
        _refuse_kinds(section, path, profile or "default")
        raise ConfigError(f"profile {profile or 'default'!r} has no whole pair of keys", origin=path)
    config = _section(_config_file(environment), _config_section(profile))
    if config is not None:
        _refuse_kinds(config, _config_file(environment), profile or "default")
    if profile:
        raise ConfigError(
            f"there is no profile {profile!r} with keys", key="AWS_PROFILE", origin=", ".join(files)
        )
    return None


def _refuse_kinds(section: Mapping[str, str], path: str, profile: str) -> None:
    for key, kind in _REFUSED_KEYS.items():
        if key in section:
            raise ConfigError(
                f"profile {profile!r} gets its credentials from {kind} ({key}), which is not done here",
                key=key,
                origin=path,
                hint=_EXPORT,
            )


def _region(environment: Mapping[str, str]) -> str:
    section = _section(_config_file(environment), _config_section(environment.get("AWS_PROFILE", "")))
    region = (section or {}).get("region", "")
    return _clean(region, key="region", origin=_config_file(environment))


def _config_file(environment: Mapping[str, str]) -> str:
    return environment.get("AWS_CONFIG_FILE") or os.path.expanduser("~/.aws/config")


def _config_section(profile: str) -> str:
    return f"profile {profile}" if profile and profile != "default" else "default"


def _google_credentials(environment: Mapping[str, str], instance: bool) -> Credentials:
    if name := next((name for name in _GOOGLE if environment.get(name)), ""):
        return Credentials({}, f"the environment, {name}")
    for path in _given_file(environment, GOOGLE_FILE):
        if os.path.exists(path):
            return Credentials({"application_credentials": path}, _named(environment, path))
    if os.path.exists(os.path.expanduser(_GCLOUD)):
        return Credentials({}, _GCLOUD)
    return Credentials({}, _INSTANCE) if instance else Credentials({**_NO_SIGNATURE}, _UNSIGNED)


_AZURE_SECRETS: Final = {"account_key", "sas_key", "client_secret"}


def _azure_credentials(environment: Mapping[str, str], instance: bool) -> Credentials:
    settings: dict[str, Any] = {}
    variables: dict[str, str] = {}  # that gave each setting
    files = _given_file(environment, AZURE_FILE)
    in_file = {name: value for path in files for name, value in _lines(path).items()}
    found = {**environment, **in_file}
    for name in (
        "ACCOUNT_NAME",
        "ACCOUNT_KEY",
        "SAS_KEY",
        "SAS_TOKEN",
        "CLIENT_ID",
        "CLIENT_SECRET",
        "TENANT_ID",
        "ENDPOINT",
    ):
        setting = "sas_key" if name == "SAS_TOKEN" else name.lower()
        for variable in (f"AZURE_{name}", f"AZURE_STORAGE_{name}"):
            if found.get(variable):
                origin = files[0] if variable in in_file else "environment"
                settings[setting] = _clean(found[variable], key=variable, origin=origin)
                variables[setting] = variable
    if in_file and not in_file.keys() & variables.values():
        raise ConfigError(
            f"{files[0]}: none of its names is known",
            origin=files[0],
            hint="such as AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
        )
    if secrets := sorted(settings.keys() & _AZURE_SECRETS):
        variable = variables[secrets[0]]
        is_in_file = variable in in_file
        source = _named(environment, files[0]) if is_in_file else f"the environment, {variable}"
        return Credentials(settings, source)
    if instance:
        return Credentials(settings, _INSTANCE)
    if environment.get("AZURE_USE_AZURE_CLI", "").lower() in _TRUE:
        return Credentials(settings, "the program az (AZURE_USE_AZURE_CLI)")
    return Credentials({**settings, **_NO_SIGNATURE}, _UNSIGNED)


def _named(environment: Mapping[str, str], path: str) -> str:
    """Return a file's path for messages, with the service manager's directory as an environment variable."""
    directory = environment.get(_DIRECTORY)
    inside = bool(directory) and os.path.dirname(path) == directory
    return f"${_DIRECTORY}/{os.path.basename(path)}" if inside else path


def _given_file(environment: Mapping[str, str], name: str) -> list[str]:
    directory = environment.get(_DIRECTORY)
    return [os.path.join(directory, name)] if directory else []


def _lines(path: str) -> dict[str, str]:
    """Return the settings of a file of lines ``NAME=VALUE``, as a shell or the service manager reads them."""
    try:
        with open(path, encoding="utf-8-sig") as file:
            lines = [line.strip() for line in file if line.strip() and not line.startswith("#")]
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError):
        raise ConfigError(f"{path} cannot be read", origin=path) from None
    if any("=" not in line for line in lines):
        raise ConfigError(f"{path} is no list of lines NAME=VALUE", origin=path)
    found = {}
    for line in lines:
        name, _, value = (part.strip() for part in line.removeprefix("export ").partition("="))
        quoted = len(value) > 1 and value[0] == value[-1] and value[0] in "\"'"
        found[name] = value[1:-1] if quoted else value
    return found


def _section(path: str, name: str) -> Mapping[str, str] | None:
    """Return a section of an INI file; None if the file or the section does not exist."""
    parser = configparser.RawConfigParser(default_section="", strict=False)
    try:
        with open(path, encoding="utf-8-sig") as file:
            parser.read_file(file)
    except FileNotFoundError:
        return None
    except PermissionError:
        raise ConfigError(f"{path} may not be read", origin=path) from None
    except (OSError, UnicodeDecodeError, configparser.Error):
        # the parser's message repeats the line, and so the secret
        raise ConfigError(f"{path} is no file of profiles", origin=path) from None
    return dict(parser[name]) if parser.has_section(name) else None
