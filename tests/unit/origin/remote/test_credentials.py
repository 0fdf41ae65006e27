# SPDX-License-Identifier: Apache-2.0
"""Credentials: from the environment, the service manager, a profile; other kinds are refused by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from shmmap.errors import ConfigError
from shmmap.origin.remote.credentials import clean_variables, credentials_source, find_credentials

SECRET = "hunter2"
ANONYMOUS = {"region": "us-east-1", "skip_signature": True}


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / ".aws").mkdir()
    return tmp_path


def s3(environment: dict[str, str], **options: bool) -> dict[str, Any]:
    return find_credentials("s3", environment, **options).settings


def google(environment: dict[str, str], **options: bool) -> dict[str, Any]:
    return find_credentials("gs", environment, **options).settings


def azure(environment: dict[str, str], **options: bool) -> dict[str, Any]:
    return find_credentials("az", environment, **options).settings


def profile(path: Path, name: str = "default", key: str = "k", **more: str) -> None:
    lines = [f"[{name}]", f"aws_access_key_id = {key}", f"aws_secret_access_key = {SECRET}"]
    lines += [f"{one} = {value}" for one, value in more.items()]
    path.write_text("\n".join(lines) + "\n")


def test_without_any_the_network_is_not_asked(home: Path) -> None:
    del home
    assert s3({}) == ANONYMOUS
    assert s3({}, instance=True) == {"region": "us-east-1"}
    assert google({}) == {"skip_signature": True}
    assert google({}, instance=True) == {}
    assert azure({}) == {"skip_signature": True}
    assert azure({}, instance=True) == {}


def test_the_environment_comes_first(home: Path) -> None:
    profile(home / ".aws/credentials")
    found, _, provider = find_credentials(
        "s3",
        {
            "AWS_ACCESS_KEY_ID": "a",
            "AWS_SECRET_ACCESS_KEY": "b",
            "AWS_SESSION_TOKEN": "c",
            "AWS_REGION": "eu",
        },
    )
    assert found == {"access_key_id": "a", "secret_access_key": "b", "session_token": "c"}
    assert provider is None
    assert s3({"AWS_SKIP_SIGNATURE": "true"}) == ANONYMOUS
    with pytest.raises(ConfigError, match="only together"):
        s3({"AWS_SECRET_ACCESS_KEY": SECRET})


def keys(environment: dict[str, str]) -> tuple[str, str | None]:
    found, _, provider = find_credentials("s3", environment)
    assert "skip_signature" not in found
    assert provider is not None
    given = provider()
    assert given["secret_access_key"] == SECRET
    return given["access_key_id"], given["token"]


def test_files_of_profiles(home: Path) -> None:
    profile(home / ".aws/credentials", aws_session_token="t")
    assert keys({}) == ("k", "t")
    other = home / "other"
    profile(other, "fleet", "f")
    assert keys({"AWS_SHARED_CREDENTIALS_FILE": str(other), "AWS_PROFILE": "fleet"}) == ("f", None)
    given = home / "given"
    given.mkdir()
    profile(given / "shmmap.aws", key="of-the-unit")
    assert keys({"CREDENTIALS_DIRECTORY": str(given)}) == ("of-the-unit", None)
    assert keys({"CREDENTIALS_DIRECTORY": str(home)}) == ("k", "t")


def test_a_file_that_is_written_again_is_read_again(home: Path) -> None:
    profile(home / ".aws/credentials")
    provider = find_credentials("s3", {}).provider
    assert provider is not None
    profile(home / ".aws/credentials", key="new")
    assert provider()["access_key_id"] == "new"


def test_the_region_of_a_profile(home: Path) -> None:
    (home / ".aws/config").write_text("[default]\nregion = eu-west-1\n[profile fleet]\nregion = us-west-2\n")
    assert s3({})["region"] == "eu-west-1"
    profile(home / ".aws/credentials", "fleet")
    assert s3({"AWS_PROFILE": "fleet"})["region"] == "us-west-2"
    assert "region" not in s3({"AWS_DEFAULT_REGION": "x"})


@pytest.mark.parametrize(
    "line",
    ["sso_session = x", "sso_start_url = https://x", "role_arn = arn:x", "credential_process = /bin/x",
     "web_identity_token_file = /x"],
)  # fmt: skip
@pytest.mark.parametrize("file", ["config", "credentials"])
def test_other_kinds_are_refused_by_name(home: Path, line: str, file: str) -> None:
    (home / ".aws" / file).write_text(f"[default]\n{line}\n")
    with pytest.raises(ConfigError) as error:
        s3({})
    assert line.split(" ")[0] in str(error.value)
    assert "aws configure export-credentials" in error.value.hint


@pytest.mark.parametrize(
    "name",
    ["AWS_WEB_IDENTITY_TOKEN_FILE", "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
     "AWS_CONTAINER_CREDENTIALS_FULL_URI"],
)  # fmt: skip
def test_other_servers_are_asked_for_credentials_only_where_that_is_wanted(home: Path, name: str) -> None:
    del home
    with pytest.raises(ConfigError, match=name) as error:
        s3({name: "x"})
    assert "--instance-credentials" in error.value.hint
    assert s3({name: "x"}, instance=True) == {"region": "us-east-1"}
    given = {name: "x", "AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b"}
    assert s3(given)["access_key_id"] == "a"


def test_profiles_that_cannot_be_used_are_errors_without_secrets(home: Path) -> None:
    with pytest.raises(ConfigError, match="there is no profile 'fleet'"):
        s3({"AWS_PROFILE": "fleet"})
    credentials = home / ".aws/credentials"
    for text in (f"aws_secret_access_key = {SECRET}\n", f"[default\nkey = {SECRET}\n", f"\xff{SECRET}"):
        credentials.write_text(text, encoding="latin-1")
        with pytest.raises(ConfigError) as error:
            s3({})
        assert SECRET not in str(error.value)
    credentials.write_text(f"[default]\naws_secret_access_key = {SECRET}\n")
    with pytest.raises(ConfigError, match="no whole pair") as error:
        s3({})
    assert SECRET not in str(error.value)


def test_google_and_azure(home: Path) -> None:
    assert google({"GOOGLE_APPLICATION_CREDENTIALS": "/x"}) == {}
    (home / "shmmap.google").write_text("{}")
    (home / "shmmap.azure").write_text(
        f"# account\nAZURE_STORAGE_ACCOUNT_NAME=a\nAZURE_STORAGE_SAS_TOKEN={SECRET}\n"
    )
    given = {"CREDENTIALS_DIRECTORY": str(home)}
    assert google(given) == {"application_credentials": str(home / "shmmap.google")}
    assert azure(given) == {"account_name": "a", "sas_key": SECRET}
    assert azure({"AZURE_STORAGE_ACCOUNT_NAME": "a", "AZURE_STORAGE_ACCOUNT_KEY": "k"}) == {
        "account_name": "a", "account_key": "k",
    }  # fmt: skip
    assert azure({"AZURE_STORAGE_ACCOUNT_NAME": "a"}) == {
        "account_name": "a",
        "skip_signature": True,
    }
    (home / "shmmap.azure").write_text(SECRET)
    with pytest.raises(ConfigError) as error:
        azure(given)
    assert SECRET not in str(error.value)


@pytest.mark.parametrize("line", ["\ufeff{}={}", "export {}={}", '{} = "{}"', "{}='{}'\r"])
def test_files_as_editors_and_shells_write_them(home: Path, line: str) -> None:
    lines = (line.format("AZURE_STORAGE_ACCOUNT_NAME", "a"), line.format("AZURE_STORAGE_SAS_TOKEN", SECRET))
    (home / "shmmap.azure").write_text("\n".join((lines[0], lines[1].lstrip("\ufeff"))))
    given = {"CREDENTIALS_DIRECTORY": str(home)}
    assert azure(given) == {"account_name": "a", "sas_key": SECRET}
    profile(home / ".aws/credentials")
    text = (home / ".aws/credentials").read_text()
    (home / ".aws/credentials").write_text(f"\ufeff{text}", encoding="utf-8", newline="\r\n")
    assert keys({}) == ("k", None)


def test_a_file_of_unknown_names_is_not_taken_for_no_credentials(home: Path) -> None:
    (home / "shmmap.azure").write_text(f"AZURE_STORAGE_KEY={SECRET}\n")
    refused(lambda: azure({"CREDENTIALS_DIRECTORY": str(home)}), "none of its names is known", "")


def test_sources_are_named_and_nothing_else(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def source(scheme: str, **environment: str) -> str:
        return credentials_source(scheme, environment)

    keys = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": SECRET}
    assert source("https", **keys) == source("file") == ""
    assert source("s3", **keys) == "the environment, AWS_ACCESS_KEY_ID"
    assert source("s3", **keys, AWS_SESSION_TOKEN="t").endswith("with AWS_SESSION_TOKEN")
    later = {"AWS_CREDENTIAL_EXPIRATION": "2999-01-01T00:00:00Z"}
    assert source("s3", **keys, **later) == "the environment, AWS_ACCESS_KEY_ID"
    with pytest.raises(ConfigError, match="expired at 2020"):
        source("s3", **keys, AWS_CREDENTIAL_EXPIRATION="2020-01-01T00:00:00Z")
    assert source("s3") == source("gs") == source("az") == "nowhere: requests are not signed"
    assert source("s3", AWS_SKIP_SIGNATURE="1") == "nowhere: requests are not signed"
    given = home / "given"
    given.mkdir()
    (given / "shmmap.aws").write_text(f"[default]\naws_access_key_id = a\naws_secret_access_key = {SECRET}\n")
    (given / "shmmap.google").write_text("{}")
    inside = {"CREDENTIALS_DIRECTORY": str(given)}
    assert source("s3", **inside) == "profile 'default' of $CREDENTIALS_DIRECTORY/shmmap.aws"
    assert source("gs", **inside) == "$CREDENTIALS_DIRECTORY/shmmap.google"
    for secret in ("ACCOUNT_KEY", "SAS_KEY", "SAS_TOKEN"):
        (given / "shmmap.azure").write_text(f"AZURE_STORAGE_{secret}={SECRET}\n")
        assert source("az", **inside) == "$CREDENTIALS_DIRECTORY/shmmap.azure"
    assert source("gs", GOOGLE_SERVICE_ACCOUNT="x") == "the environment, GOOGLE_SERVICE_ACCOUNT"
    for variable in ("AZURE_STORAGE_SAS_KEY", "AZURE_STORAGE_SAS_TOKEN", "AZURE_CLIENT_SECRET"):
        assert source("az", **{variable: "x"}) == f"the environment, {variable}"
    assert (
        credentials_source("s3", {}, instance=True) == "the cloud's metadata address (instance_credentials)"
    )


# --- characters that no request can contain ----------------------------------------------------------

SPOILT = {
    "\n": "a line break",
    "\r\n": "a line break",
    "\t": "a tabulator",
    "\x00": "U+0000",
    "\u200b": "U+200B",
}


def refused(find: Callable[[], object], name: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        find()
    assert name in caught.value.message
    assert says in caught.value.message
    assert SECRET not in str(caught.value)
    assert caught.value.exit_code == 78


@pytest.mark.parametrize("character", SPOILT)
def test_a_value_with_a_line_break_is_refused_by_the_name_of_its_place(home: Path, character: str) -> None:
    says, value = SPOILT[character], f"{SECRET}{character}{SECRET}"
    keys = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_SESSION_TOKEN": "c"}
    for name in (*keys, "AWS_REGION", "AWS_ENDPOINT_URL"):
        refused(partial(s3, {**keys, name: value}), name, says)
    for name in ("AZURE_STORAGE_ACCOUNT_KEY", "AZURE_STORAGE_SAS_TOKEN", "AZURE_CLIENT_SECRET"):
        refused(partial(azure, {name: value}), name, says)
    token = home / "token"
    token.write_text(value, newline="")
    for name in ("AWS_WEB_IDENTITY_TOKEN_FILE", "AWS_CONTAINER_AUTHORIZATION_TOKEN_FILE"):
        refused(partial(s3, {name: str(token)}, instance=True), str(token), says)
    if character == "\u200b":
        profile(home / ".aws/credentials", aws_session_token=value)
        refused(lambda: s3({}), "aws_session_token", says)
        (home / "shmmap.azure").write_text(f"AZURE_STORAGE_ACCOUNT_KEY={value}\n")
        refused(lambda: azure({"CREDENTIALS_DIRECTORY": str(home)}), "AZURE_STORAGE_ACCOUNT_KEY", says)


def test_white_space_around_a_value_is_left_out(home: Path) -> None:
    token = home / "token"
    token.write_text(f"{SECRET}\n")
    environment = {
        "AWS_ACCESS_KEY_ID": "a\n", "AWS_SECRET_ACCESS_KEY": " b\r\n", "AWS_SESSION_TOKEN": "c\n",
        "AWS_REGION": "eu\n", "AWS_WEB_IDENTITY_TOKEN_FILE": str(token), "AWS_PROMPT": "\x1b[1m",
    }  # fmt: skip
    assert s3(environment) == {"access_key_id": "a", "secret_access_key": "b", "session_token": "c"}
    assert clean_variables(environment)["AWS_REGION"] == "eu"
    assert azure({"AZURE_STORAGE_SAS_TOKEN": "sv=1\n"}) == {"sas_key": "sv=1"}
    assert google({"GOOGLE_SERVICE_ACCOUNT_KEY": '{\n  "type": "service_account"\n}\n'}) == {}
