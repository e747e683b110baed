"""The request for a localisation, and the map that it names."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarslam.core.errors import ConfigError, InputError
from lidarslam.mapping.fixed_map.fixed_map import FixedMap
from lidarslam.mapping.global_map.global_map import PointCloud
from lidarslam.run.request import RunRequest, describe_run
from lidarslam.storage.finished_run import load_map

# A map of fewer points is not worth a search.
_FEWEST_POINTS = 1000


@dataclass(frozen=True)
class LocaliseRequest:
    """A recording, and the map that it is to be found in."""

    run: RunRequest  # the recording, and where the results go; no checkpoints
    map: Path  # a run directory, a .ply or a .pcd file with normals
    guess: tuple[float, float, float] | None = None  # rough x, y (m) and heading (degrees) of the first scan in the map

    def describe(self) -> dict[str, Any]:
        """For config.yaml."""
        guess = None if self.guess is None else list(self.guess)
        return describe_run(self.run) | {"map": str(self.map.resolve()), "guess": guess}


def read_map(request: LocaliseRequest) -> tuple[PointCloud, FixedMap]:
    """The points of the map, and the map to register to.

    Raises:
        InputError: there is no map, or it is too small or without normals.
        ConfigError: another registration than that to surfels is configured.
    """
    if request.run.config.mapping.method != "surfels":
        raise ConfigError("mapping.method: scans are localised by registration to surfels; leave the setting out")
    cloud = load_map(request.map)
    if len(cloud) < _FEWEST_POINTS:
        raise InputError(f"{request.map}: holds no map to localise in ({len(cloud):,} points)")
    if not cloud.normals[:, :2].any():
        raise InputError(f"{request.map}: has points without normals, which say from which side walls were seen")
    return cloud, FixedMap(cloud.points, cloud.normals)
