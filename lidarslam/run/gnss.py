"""GNSS in a run: the positions that hold its pose graph, and its results in UTM."""

import logging
from typing import TYPE_CHECKING

from lidarslam.core.errors import InputError
from lidarslam.run.request import RunRequest

if TYPE_CHECKING:  # loads SciPy and the pose graph
    from lidarslam.mapping.pose_graph.antenna import ProjectedTrack

logger = logging.getLogger(__name__)

# The folder of a run's results in UTM.
UTM_FOLDER = "utm"


def gnss_track(request: RunRequest) -> "ProjectedTrack | None":
    """The GNSS track of a recording, in UTM; None where the pose graph uses none.

    Raises:
        InputError: the recording has no GNSS positions.
        ConfigError: pyproj is not installed.
    """
    if not (request.config.pose_graph.enabled and request.config.pose_graph.gnss):
        return None
    from lidarslam.exports.gnss import read_gnss
    from lidarslam.exports.projection import utm_around
    from lidarslam.mapping.pose_graph.antenna import ProjectedTrack

    track = read_gnss(request.source, request.config.reader)
    utm = utm_around(track.geodetic)
    return ProjectedTrack(track, utm.project(track.geodetic), utm.scale)


def write_in_utm(request: RunRequest) -> None:
    """Write map and trajectory of a finished run in UTM, in a folder of its own; see `lidarslam.exports.geo`.

    Positions that do not determine the heading are a warning: the run is there.

    Raises:
        OutputError: a file cannot be written.
    """
    from lidarslam.exports.geo import export_geo, georeference

    try:
        for line in export_geo(georeference(request.out), request.out / UTM_FOLDER, overwrite=True):
            logger.info(line)
    except InputError as error:
        logger.warning("not written in UTM: %s", error)
