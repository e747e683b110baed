"""Maps coloured by their errors, on disk."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from evaluation.map.metrics import CloudErrors, MapComparison
from evaluation.report.error_colours import error_colours
from lidarslam.core.errors import OutputError
from lidarslam.core.files import replacing
from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.writers.ply import write_ply

SUFFIXES = (".ply", ".rrd")


def check_error_files(paths: Sequence[Path]) -> None:
    """Refuse what could not be written later.

    Raises:
        OutputError: a file's name ends in neither .ply nor .rrd, or its folder does not exist.
    """
    for path in paths:
        if path.suffix.lower() not in SUFFIXES:
            raise OutputError(f"{path}: the errors can be written as {' or '.join(SUFFIXES)}; name such a file")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: there is no folder {path.parent}; make it first")


def write_errors(path: Path, comparison: MapComparison, positions: FloatArray | None, clip_m: float) -> None:
    """Write the map coloured by its distance to the reference.

    A .ply file holds the map's points in the reference's frame, in double precision, with colours and the distance
    of each. A .rrd file, for Rerun, holds the reference coloured by its distance to the map too, and the path
    (K, 3) where the sensor was, in the reference's frame.

    Raises:
        OutputError: it cannot be written.
    """
    with replacing(path) as partial:
        if path.suffix.lower() == ".ply":
            try:
                write_ply(partial, _vertices(comparison.map_errors, clip_m))
            except OSError as error:
                raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error
            return
        from lidarslam.viewer.rerun_runs import save_errors

        save_errors(partial, comparison, positions, clip_m)


def _vertices(errors: CloudErrors, clip_m: float) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    fields = [
        *((axis, "<f8") for axis in "xyz"),
        *((c, "|u1") for c in ("red", "green", "blue")),
        ("distance_m", "<f4"),
    ]
    vertices = np.empty(len(errors.points), fields)
    colours = error_colours(errors.distances_m, clip_m)
    for column, (axis, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertices[axis], vertices[colour] = errors.points[:, column], colours[:, column]
    vertices["distance_m"] = errors.distances_m
    return vertices
