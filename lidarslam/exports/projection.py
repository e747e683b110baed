"""UTM by pyproj, of the extra `geo`."""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from lidarslam.core.errors import ConfigError
from lidarslam.core.geometry import FloatArray

_NORTH, _SOUTH = 32600, 32700  # EPSG codes of the zones of WGS 84


@dataclass(frozen=True, eq=False)
class Utm:
    """The UTM zone of a place."""

    epsg: int  # code of the coordinate system
    name: str  # such as WGS 84 / UTM zone 32N
    wkt: str  # its definition, in the first version of the language, which LAS has
    scale: float  # of the projection at the place
    convergence_deg: float  # of the meridians there: grid north is this far east of true north
    _forward: Any  # pyproj's transformer

    def project(self, geodetic: FloatArray) -> FloatArray:
        """East, north and height (N, 3) of latitude, longitude and height."""
        east, north = self._forward.transform(geodetic[:, 1], geodetic[:, 0])
        return np.column_stack([east, north, geodetic[:, 2]])

    def geodetic(self, projected: FloatArray) -> FloatArray:
        """Latitude, longitude and height (N, 3) of east, north and height."""
        longitude, latitude = self._forward.transform(projected[:, 0], projected[:, 1], direction="INVERSE")
        return np.column_stack([latitude, longitude, projected[:, 2]])


def utm_around(geodetic: FloatArray) -> Utm:
    """The zone of most positions (N, 3): latitude and longitude in degrees, height.

    Raises:
        ConfigError: pyproj is not installed.
    """
    try:
        pyproj: Any = import_module("pyproj")
    except ModuleNotFoundError as error:
        raise ConfigError("georeferenced output needs pyproj; pip install 'lidarslam[geo]'") from error
    latitude_deg, longitude_deg = np.median(geodetic[:, :2], axis=0).tolist()
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    epsg = (_NORTH if latitude_deg >= 0.0 else _SOUTH) + zone
    crs = pyproj.CRS.from_epsg(epsg)
    factors = pyproj.Proj(crs).get_factors(longitude_deg, latitude_deg)
    return Utm(
        epsg=epsg,
        name=str(crs.name),
        wkt=str(crs.to_wkt("WKT1_GDAL")),
        scale=float(factors.meridional_scale),
        convergence_deg=float(factors.meridian_convergence),
        _forward=pyproj.Transformer.from_crs(4326, crs, always_xy=True),
    )
