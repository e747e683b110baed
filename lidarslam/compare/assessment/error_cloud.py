"""Maps coloured by their errors, on disk."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarslam.core.errors import OutputError
from lidarslam.core.files import replacing
from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.map.metrics import MapComparison
from lidarslam.evaluation.report.error_colours import DISTANCE_FIELD, error_colours
from lidarslam.simulation.writers import write_ply

_SUFFIXES = (".ply", ".rrd")
_FIELDS = [
    *((axis, "<f8") for axis in "xyz"),
    *((colour, "|u1") for colour in ("red", "green", "blue")),
    (DISTANCE_FIELD, "<f4"),
]


def check_error_files(paths: Sequence[Path]) -> None:
    """Refuse files that cannot be written later.

    Raises:
        OutputError: a file's name ends in neither .ply nor .rrd, or its folder does not exist.
    """
    for path in paths:
        if path.suffix.lower() not in _SUFFIXES:
            raise OutputError(f"{path}: the errors can be written as {' or '.join(_SUFFIXES)}; name such a file")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: there is no folder {path.parent}; make it first")


def write_errors(path: Path, comparison: MapComparison, positions: FloatArray, clip_m: float) -> None:
    """Write the map coloured by its distance from the reference, in the reference's frame.

    A .ply file holds the points in double precision, with colours and distances. A .rrd file, for Rerun, also holds
    the reference coloured by its distance from the map, and the sensor's path (K, 3).

    Raises:
        OutputError: it cannot be written.
    """
    with replacing(path) as partial:
        if path.suffix.lower() == ".rrd":
            from lidarslam.viewer.rerun_errors import save_errors

            save_errors(partial, comparison, positions, clip_m)
            return
        errors = comparison.map_errors
        vertices = np.empty(len(errors.points), _FIELDS)
        columns = [*errors.points.T, *error_colours(errors.distances_m, clip_m).T, errors.distances_m]
        for (name, _), column in zip(_FIELDS, columns, strict=True):
            vertices[name] = column
        try:
            write_ply(partial, vertices)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
