# SPDX-License-Identifier: Apache-2.0
"""moto's S3 server on loopback, in a process of its own, which writes down what is asked of it.

``python -m tests.support.bucket_server LOG`` prints its port.  A line of LOG is ``METHOD PATH STATUS BYTES``.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import urllib.request
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support.daemon_process import ROOT

BUCKET = "maps"
KEYS = {
    "AWS_ACCESS_KEY_ID": "of-the-tests",
    "AWS_SECRET_ACCESS_KEY": "a-secret-of-the-tests",
    "AWS_REGION": "us-east-1",
}
"""Credentials are always given: without any, a library might ask the cloud's metadata address."""


class BucketServer:
    """A running server."""

    def __init__(self, port: int, log: Path) -> None:
        self.endpoint = f"http://127.0.0.1:{port}"
        self.environment = {**KEYS, "AWS_ENDPOINT_URL": self.endpoint}
        self._log = log
        self._seen = 0

    def url(self, name: str) -> str:
        """URL of a map in the bucket."""
        return f"s3://{BUCKET}/{name}"

    def requests(self) -> list[tuple[str, str, int, int]]:
        """What was asked since the last call: method, path, status, and bytes received."""
        lines = self._log.read_text().splitlines()
        new, self._seen = lines[self._seen :], len(lines)
        return [(m, p, int(s), int(n)) for m, p, s, n in (line.split(" ") for line in new)]

    def received(self) -> list[str]:
        """Paths of the objects that were written since the last call."""
        return [path for method, path, status, _ in self.requests() if method == "PUT" and status < 300]


@contextmanager
def bucket_server(folder: Path) -> Iterator[BucketServer]:
    """Run a server until the end of the block."""
    log = folder / "requests.log"
    log.touch()
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-m", "tests.support.bucket_server", str(log)],
        cwd=ROOT, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        server = BucketServer(int(process.stdout.readline()), log)
        urllib.request.urlopen(
            urllib.request.Request(f"{server.endpoint}/{BUCKET}", method="PUT"), timeout=30
        ).close()
        yield server
    finally:
        process.kill()
        process.communicate()


def main() -> None:
    """Serve until stdin is closed."""
    import logging
    import threading

    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    inner: Any = DomainDispatcherApplication(create_backend_app)
    changing = threading.Lock()  # a store compares and switches in one step, moto in two

    with open(sys.argv[1], "a", buffering=1, encoding="utf-8") as log:

        def written_down(environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
            def respond(status: str, headers: Any, *more: Any) -> Any:
                size = environ.get("CONTENT_LENGTH") or "0"
                log.write(f"{environ['REQUEST_METHOD']} {environ['PATH_INFO']} {status[:3]} {size}\n")
                return start_response(status, headers, *more)

            with contextlib.nullcontext() if environ["REQUEST_METHOD"] in ("GET", "HEAD") else changing:
                answer: Iterable[bytes] = inner(environ, respond)
            return answer

        server = make_server("127.0.0.1", 0, written_down, threaded=True)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        print(server.port, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
