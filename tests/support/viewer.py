# SPDX-License-Identifier: Apache-2.0
"""What a browser does with ``shmmap view --browser``: opens its websocket, and says where it looks.

Messages are viser's: a zstd frame of MessagePack, then the arrays that it names.
"""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import Any

import msgspec
import numpy as np
import viser
import websockets.sync.client as sync
import zstandard
from numpy.typing import NDArray


class Viewer:
    """A browser's side of the connection.

    Parameters
    ----------
    url
        The address that was printed.
    headers
        ``Origin`` and others instead of a browser's own.

    Attributes
    ----------
    clouds
        Points of each node, (N, 3) about its position, by its name.
    positions
        Positions of nodes, by name.
    nbytes
        Bytes received.
    first_s
        Seconds until the first points came; infinity before.
    """

    def __init__(self, url: str, *, origin: str | None = "") -> None:
        address = url.removeprefix("http://").rstrip("/")
        host = address.partition("/")[0]
        self._began_s = time.monotonic()
        self._socket = sync.connect(
            f"ws://{address}",
            origin=f"http://{host}" if origin == "" else origin,  # type: ignore[arg-type]
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            max_size=None,
            proxy=None,
        )
        self.clouds: dict[str, NDArray[np.float16]] = {}
        self.sizes: dict[str, float] = {}
        self.positions: dict[str, tuple[float, ...]] = {}
        self.labels: dict[str, str] = {}
        self.nodes: dict[str, str] = {}
        self.texts: dict[str, Any] = {}
        self.nbytes = 0
        self.first_s = math.inf

    def __enter__(self) -> Viewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the page."""
        self._socket.close()

    def look(
        self, position: tuple[float, float, float], at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        """Look from a position, relative to the scene's origin."""
        message = {
            "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": position, "fov": 1.3,
            "near": 0.1, "far": 1000.0, "image_height": 800, "image_width": 1280, "look_at": at,
            "up_direction": (0.0, 0.0, 1.0),
        }  # fmt: skip
        self._socket.send(msgspec.msgpack.encode(message))

    def receive(self, timeout_s: float) -> bool:
        """Take one message of the server; return False if none came in time."""
        try:
            data = self._socket.recv(timeout=timeout_s)
        except TimeoutError:
            return False
        assert isinstance(data, bytes)
        self.nbytes += len(data)
        packed = int.from_bytes(data[8:16], "little")
        frame = zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed])
        content = msgspec.msgpack.decode(frame)
        at, arrays = 16 + packed, []
        for length in content["binaryBufferLengths"]:
            at += -at % 8
            arrays.append(data[at : at + length])
            at += length
        for message in content["messages"]:
            self._take(message, arrays)
        return True

    def quiet(self, quiet_s: float = 1.0, most_s: float = 60.0) -> None:
        """Receive until no points have come for a while."""
        last = time.monotonic()
        end = last + most_s
        while time.monotonic() < min(end, last + quiet_s):
            before = len(self.clouds), self.nbytes
            self.receive(quiet_s / 4)
            if len(self.clouds) != before[0] or self.nbytes > before[1] + 20_000:
                last = time.monotonic()

    def _take(self, message: dict[str, Any], arrays: list[bytes]) -> None:
        kind, name = message["type"], message.get("name", "")
        if kind == "PointCloudMessage":
            props = message["props"]
            data = arrays[props["points"]["__binary_index"]]
            self.clouds[name] = np.frombuffer(data, np.float16).reshape(-1, 3)
            self.sizes[name] = props["point_size"]
            self.first_s = min(self.first_s, time.monotonic() - self._began_s)
        elif kind == "SetPositionMessage":
            self.positions[name] = tuple(message["position"])
        elif kind == "LabelMessage":
            self.labels[name] = message["props"]["text"]
        elif kind == "RemoveSceneNodeMessage":
            for known in (self.clouds, self.sizes, self.labels, self.nodes):
                known.pop(name, None)
            return
        elif kind == "GuiUpdateMessage":
            self.texts.setdefault(message["uuid"], {}).update(message["updates"])
        if "props" in message and name:
            self.nodes[name] = kind

    @property
    def points(self) -> int:
        """Points on the page."""
        return sum(map(len, self.clouds.values()))
