"""Errors of a map in Rerun."""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lidarslam.core.files import cannot_write
from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.map.metrics import CloudErrors, MapComparison
from lidarslam.evaluation.report.error_colours import error_colours
from lidarslam.viewer.rerun_recording import (
    BACKGROUND,
    MAP_RADIUS,
    PATH_RADIUS,
    REFERENCE_COLOUR,
    IncompleteRecordingError,
    rerun_recording,
)


def save_errors(path: Path, comparison: MapComparison, positions: FloatArray | None, clip_m: float) -> None:
    """Write a .rrd file of a map coloured by its distance to the reference, and of the reference by that to the map.

    The clouds are shown about their middle, because the viewer counts in single precision, with the path (K, 3) of the
    sensor in the reference's frame; `clip_m` is the distance of the brightest colour.

    Raises:
        OutputError: the file cannot be written.
    """
    points = comparison.reference_errors.points
    middle = np.round(points.mean(axis=0)) if len(points) else np.zeros(3)
    try:
        with rerun_recording("map errors", path, blueprint=_blueprint()) as recording:
            _log_errors(recording, "world/map_to_reference", comparison.map_errors, middle, clip_m)
            _log_errors(recording, "world/reference_to_map", comparison.reference_errors, middle, clip_m)
            if positions is not None:
                line = rr.LineStrips3D([positions - middle], colors=[REFERENCE_COLOUR], radii=PATH_RADIUS)
                recording.log("world/path", line, static=True)
            origin = ", ".join(f"{m:.0f}" for m in middle)
            text = f"dark: 0 m, bright: {clip_m:g} m and more; the origin is at {origin}"
            recording.log("legend", rr.TextDocument(text), static=True)
    except (OSError, IncompleteRecordingError) as error:
        raise cannot_write(path, error) from error


def _log_errors(
    recording: rr.RecordingStream, entity: str, errors: CloudErrors, middle: FloatArray, clip_m: float
) -> None:
    colours = error_colours(errors.distances_m, clip_m)
    recording.log(entity, rr.Points3D(errors.points - middle, colors=colours, radii=MAP_RADIUS), static=True)


def _blueprint() -> rrb.Blueprint:
    """Both clouds side by side, above the legend."""
    titles = {
        "map_to_reference": "Map: distance to the reference",
        "reference_to_map": "Reference: distance to the map",
    }
    views = [
        rrb.Spatial3DView(
            origin="/world", name=title, contents=["/world/path", f"/world/{entity}"], background=BACKGROUND
        )
        for entity, title in titles.items()
    ]
    legend = rrb.TextDocumentView(origin="/legend", name="Colours")
    return rrb.Blueprint(rrb.Vertical(rrb.Horizontal(*views), legend, row_shares=[8, 1]), collapse_panels=True)
