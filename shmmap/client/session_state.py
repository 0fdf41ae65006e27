# SPDX-License-Identifier: Apache-2.0
"""What a client of either kind knows of its session and the map without asking."""

from __future__ import annotations

from typing import NamedTuple

from shmmap.client.session import Session
from shmmap.errors import ShmmapError
from shmmap.protocol.messages import Welcome


class MapOrigin(NamedTuple):
    """Transform from the map frame back to the coordinates of the files that a map was divided from.

    ``(point + (x, y, z)) / unit`` is the point in the files' coordinate system, in float64.

    Attributes
    ----------
    x, y, z : float
        Offset that `divide` subtracted from each point, metres; 0 if none was subtracted, or if it is not
        known.
    crs : str or None
        Name of the coordinate system, with its EPSG code if the files contain it; None if they name no
        system.
    unit_m : tuple of float
        Length of the system's units in metres, horizontal and vertical; (1, 1) unless another unit was
        converted.
    """

    x: float
    y: float
    z: float
    crs: str | None
    unit_m: tuple[float, float]


class SessionState:
    """What a client knows of its session and the map without asking."""

    _session: Session

    def _repr_html_(self) -> str | None:
        """Return a table for a notebook, of what is known without a request; None where it cannot be made."""
        try:
            from shmmap.client import notebook  # few programs are notebooks
        except ShmmapError:  # the package was replaced
            return None
        return notebook.client_html(self)

    @property
    def timeout(self) -> float:
        """Seconds a reply may take, in addition to the time that the request lets the daemon wait."""
        return self._session.timeout_s

    @property
    def welcome(self) -> Welcome:
        """Description of the daemon and its map, as received when the session began."""
        return self._session.welcome

    @property
    def endpoint(self) -> str:
        """Path of the daemon's socket."""
        return self._session.path

    @property
    def disconnected_since(self) -> float | None:
        """`time.monotonic` of when the connection to the daemon broke; None while it stands.

        Known at once when the daemon ends.  The next request connects again by itself.
        """
        return self._session.lost_since

    @property
    def epoch(self) -> int:
        """Identifier of the daemon run that the session is with."""
        return self._session.welcome.epoch

    @property
    def map_version(self) -> int:
        """State of the map that the last answer described."""
        return self._session.map_version

    @property
    def frame_id(self) -> str:
        """Name of the map frame, as of when the session began."""
        return self._session.welcome.frame_id

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Box around all cells of the map, (min_x, min_y, max_x, max_y), metres, map frame.

        As of when the session began; None where the map has no cells.
        """
        return self._session.welcome.bounds

    @property
    def map_origin(self) -> MapOrigin:
        """Where the map frame lies in the world, as of when the session began."""
        welcome = self._session.welcome
        return MapOrigin(*welcome.origin, welcome.crs or None, welcome.unit_m)

    @property
    def session(self) -> Session:
        """State that all requests of this client share; for use by windows."""
        return self._session
