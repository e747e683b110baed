"""The raw scans of a recording in Rerun, over time."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.recording import Recording
from lidarslam.evaluation.report.error_colours import viridis
from lidarslam.viewer.annotations import levels
from lidarslam.viewer.rerun_output import Show
from lidarslam.viewer.rerun_recording import (
    BACKGROUND,
    PATH_RADIUS,
    REFERENCE_COLOUR,
    SCAN_RADIUS,
    TIME,
    about_its_start,
    every_nth,
    set_stamp,
)

_LIDAR = "world/lidar"
# Where the eye begins to follow the sensor, metres.
_BEHIND = (-40.0, 0.0, 25.0)


def show_scans(
    recording: Recording,
    source: Path,
    chosen: range,
    config: ViewerConfig,
    bar: Callable[[str], AbstractContextManager[Callable[[int, int], None]]],
    tell: Callable[[str], None],
) -> Show:
    """Scans about the sensor, by intensity or else by height; where there is a true path, the scans on it too.

    The scans are read while they are logged; `bar` makes a progress bar of a name, to be called with the number of
    scans done, and the total, and `tell` is called with each fault of the recording, as a line.
    """
    truth = recording.ground_truth
    if truth is not None:
        truth = about_its_start(truth, least=2)

    def log(stream: rr.RecordingStream) -> None:
        if truth is not None:
            path = rr.LineStrips3D([truth.positions], colors=[REFERENCE_COLOUR], radii=PATH_RADIUS)
            stream.log("world/ground truth", path, static=True)
            # The eye follows only drawn entities.
            place = rr.Points3D([[0.0, 0.0, 0.0]], colors=[REFERENCE_COLOUR], radii=2.0 * PATH_RADIUS)
            stream.log(_LIDAR, place, static=True)
        faults, done = Faults(), 0
        with bar(source.name) as count:
            for done, scan in enumerate(take_in(recording, chosen, faults), start=1):
                _log_scan(stream, done - 1, scan, truth, config.scan_points)
                count(done, len(chosen))
        for warning in (*recording.warnings, *faults.warnings()):
            tell(warning)
        if not done:
            raise InputError(f"{source}: no scan can be read")

    return Show(source.name, _blueprint(truth is not None), log)


def _log_scan(recording: rr.RecordingStream, index: int, scan: Scan, truth: Trajectory | None, points: int) -> None:
    set_stamp(recording, index, scan.stamp)
    if truth is not None:  # beyond its ends its first or last pose
        stamp = np.clip(scan.stamp, truth.stamps[0], truth.stamps[-1])
        T_world_lidar = truth.at(np.array([stamp]))[0]
        recording.log(_LIDAR, rr.Transform3D(translation=T_world_lidar[:3, 3], mat3x3=T_world_lidar[:3, :3]))
    shown = every_nth(scan.points, points)
    values = shown[:, 2]
    if scan.intensities is not None:  # the darkest where there is none
        values = np.nan_to_num(every_nth(scan.intensities, points).astype(np.float64))
    recording.log(f"{_LIDAR}/scan", rr.Points3D(shown, colors=viridis(levels(values)), radii=SCAN_RADIUS))


def _blueprint(has_truth: bool) -> rrb.Blueprint:
    """The scan in the frame of the sensor, next to the scan on the true path."""
    scan = rrb.Spatial3DView(origin=f"/{_LIDAR}", name="Scan", background=BACKGROUND)
    views = [scan]
    if has_truth:
        eye = rrb.EyeControls3D(position=_BEHIND, look_target=(0.0, 0.0, 0.0), tracking_entity=f"/{_LIDAR}")
        on_path = rrb.Spatial3DView(origin="/world", name="On the true path", background=BACKGROUND, eye_controls=eye)
        views.append(on_path)
    panel = rrb.TimePanel(timeline=TIME, play_state="playing", loop_mode="all", state="collapsed")
    return rrb.Blueprint(rrb.Horizontal(*views), panel, collapse_panels=True)
