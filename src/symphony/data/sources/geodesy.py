"""From latitude and longitude to metres on a plane, as maps in OpenStreetMap's format need it."""

from __future__ import annotations

import numpy as np

from symphony.data.sources.base import Doubles
from symphony.errors import DataError

MAX_LATITUDE = 84.0  # degrees up to which UTM is defined
SEMI_MAJOR, FLATTENING = 6_378_137.0, 1 / 298.257223563  # of the WGS 84 ellipsoid, metres
_UTM_SCALE = 0.9996


def utm(places: Doubles, origin: Doubles) -> Doubles:
    """Universal Transverse Mercator on WGS 84, in the zone of the origin, relative to the origin.

    Lanelet2's and INTERACTION's usual projection (there about latitude and longitude 0). Krüger's series to the
    fourth order in the third flattening (Karney, 2011, arXiv:1002.1417, eq. 35): well below a millimetre inside a
    zone.

    Takes places [N, 2] and an origin [2] of latitude and longitude in degrees, and gives [N, 2] metres, x towards the
    grid's east, y towards its north. Latitudes beyond 84 degrees are a :class:`DataError`.
    """
    both = _checked(places, origin)
    zone = np.clip(np.floor((origin[1] + 180) / 6), 0, 59)
    n = FLATTENING / (2 - FLATTENING)
    radius = SEMI_MAJOR / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    series = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180,
        13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140,
        49561 * n**4 / 161280,
    )
    latitude, longitude = np.radians(both - (0, 6 * zone - 177)).T
    eccentricity = np.sqrt(FLATTENING * (2 - FLATTENING))
    sine = np.sin(latitude)
    # Tangent of the conformal latitude.
    tangent = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    xi = np.arctan2(tangent, np.cos(longitude))
    eta = np.arcsinh(np.sin(longitude) / np.hypot(tangent, np.cos(longitude)))
    x, y = eta.copy(), xi.copy()
    for k, factor in enumerate(series, start=1):
        x += factor * np.cos(2 * k * xi) * np.sinh(2 * k * eta)
        y += factor * np.sin(2 * k * xi) * np.cosh(2 * k * eta)
    metres = _UTM_SCALE * radius * np.stack([x, y], axis=-1)
    return metres[:-1] - metres[-1]


def mercator(places: Doubles, origin: Doubles) -> Doubles:
    """Spherical Mercator, scaled to be true to length at the origin, relative to the origin.

    The projection of the Test Area Autonomous Driving Baden-Württemberg recordings, and of Lanelet2's
    ``SphericalMercatorProjector``. Arguments, result and errors are those of :func:`utm`.
    """
    latitude, longitude = np.radians(_checked(places, origin)).T
    scale = SEMI_MAJOR * np.cos(np.radians(origin[0]))
    metres = scale * np.stack([longitude, np.arctanh(np.sin(latitude))], axis=-1)
    return metres[:-1] - metres[-1]


def _checked(places: Doubles, origin: Doubles) -> Doubles:
    """Return [N + 1, 2] degrees, the origin last."""
    both = np.concatenate([places.reshape(-1, 2), origin[None]])
    if not (np.abs(both) <= (MAX_LATITUDE, 180)).all():  # comparisons with NaN are false
        raise DataError(
            f"a place outside latitudes ±{MAX_LATITUDE:g} and longitudes ±180 degrees", field="lat, lon"
        )
    return both
