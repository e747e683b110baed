"""The raw scans of a recording in Rerun, over time."""

from collections.abc import Iterable

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.geometry import inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.viewer.picture import height_colours
from lidarslam.viewer.rerun_output import Show
from lidarslam.viewer.rerun_recording import (
    BACKGROUND,
    PATH_RADIUS,
    REFERENCE_COLOUR,
    SCAN_RADIUS,
    TIME,
    every_nth,
    set_stamp,
)

_LIDAR = "world/lidar"
# Where the eye begins to follow the sensor, metres.
_BEHIND = (-40.0, 0.0, 25.0)


def show_scans(name: str, scans: Iterable[Scan], truth: Trajectory | None, config: ViewerConfig) -> Show:
    """Scans about the sensor, coloured by height; where there is a true path, it and the scans on it too.

    Args:
        name: of the recording.
        scans: in the order of time; read while they are logged.
        truth: the true trajectory.
        config: how many points are shown.
    """
    if truth is not None:  # the viewer counts in single precision
        truth = truth.transformed(inverse(truth.T_world_lidar[0])) if len(truth) >= 2 else None

    def log(recording: rr.RecordingStream) -> None:
        if truth is not None:
            path = rr.LineStrips3D([truth.positions], colors=[REFERENCE_COLOUR], radii=PATH_RADIUS)
            recording.log("world/ground truth", path, static=True)
            # The eye follows only what is drawn.
            place = rr.Points3D([[0.0, 0.0, 0.0]], colors=[REFERENCE_COLOUR], radii=2.0 * PATH_RADIUS)
            recording.log(_LIDAR, place, static=True)
        for index, scan in enumerate(scans):
            _log_scan(recording, index, scan, truth, config.scan_points)

    return Show(name, _blueprint(truth is not None), log)


def _log_scan(recording: rr.RecordingStream, index: int, scan: Scan, truth: Trajectory | None, points: int) -> None:
    set_stamp(recording, index, scan.stamp)
    if truth is not None:  # beyond its ends its first or last pose
        stamp = np.clip(scan.stamp, truth.stamps[0], truth.stamps[-1])
        T_world_lidar = truth.at(np.array([stamp]))[0]
        recording.log(_LIDAR, rr.Transform3D(translation=T_world_lidar[:3, 3], mat3x3=T_world_lidar[:3, :3]))
    shown = every_nth(scan.points, points)
    recording.log(f"{_LIDAR}/scan", rr.Points3D(shown, colors=height_colours(shown), radii=SCAN_RADIUS))


def _blueprint(has_truth: bool) -> rrb.Blueprint:
    """The scan in the frame of the sensor, beside the scan on the true path."""
    scan = rrb.Spatial3DView(origin=f"/{_LIDAR}", name="Scan", background=BACKGROUND)
    views = [scan]
    if has_truth:
        eye = rrb.EyeControls3D(position=_BEHIND, look_target=(0.0, 0.0, 0.0), tracking_entity=f"/{_LIDAR}")
        on_path = rrb.Spatial3DView(origin="/world", name="On the true path", background=BACKGROUND, eye_controls=eye)
        views.append(on_path)
    panel = rrb.TimePanel(timeline=TIME, play_state="playing", loop_mode="all", state="collapsed")
    return rrb.Blueprint(rrb.Horizontal(*views), panel, collapse_panels=True)
