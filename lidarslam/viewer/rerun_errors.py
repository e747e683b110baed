"""Errors of a map in Rerun."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.map.metrics import MapComparison
from lidarslam.evaluation.report.error_colours import error_colours
from lidarslam.viewer.rerun_output import Show
from lidarslam.viewer.rerun_recording import BACKGROUND, MAP_RADIUS, PATH_RADIUS, REFERENCE_COLOUR


def show_errors(comparison: MapComparison, positions: FloatArray, clip_m: float) -> Show:
    """A map coloured by its distance to the reference, and the reference by that to the map.

    The clouds are shown about their middle, because the viewer counts in single precision, with the path (K, 3) of the
    sensor in the reference's frame; `clip_m` is the distance of the brightest colour.
    """
    points = comparison.reference_errors.points
    middle = np.round(points.mean(axis=0)) if len(points) else np.zeros(3)
    clouds = {"map_to_reference": comparison.map_errors, "reference_to_map": comparison.reference_errors}

    def log(recording: rr.RecordingStream) -> None:
        for entity, errors in clouds.items():
            colours = error_colours(errors.distances_m, clip_m)
            cloud = rr.Points3D(errors.points - middle, colors=colours, radii=MAP_RADIUS)
            recording.log(f"world/{entity}", cloud, static=True)
        line = rr.LineStrips3D([positions - middle], colors=[REFERENCE_COLOUR], radii=PATH_RADIUS)
        recording.log("world/path", line, static=True)
        origin = ", ".join(f"{m:.0f}" for m in middle)
        text = f"dark: 0 m, bright: {clip_m:g} m and more; the origin is at {origin}"
        recording.log("legend", rr.TextDocument(text), static=True)

    return Show("map errors", _blueprint(), log)


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
