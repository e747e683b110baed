"""A run in Rerun while it is running."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.estimates import STAGES, ScanEstimate
from lidarslam.viewer.rerun_program import GRPC_PORT, open_window
from lidarslam.viewer.rerun_recording import (
    BACKGROUND,
    PATH_RADIUS,
    SCAN,
    SCAN_RADIUS,
    STATUS_COLOURS,
    every_nth,
    log_map,
    rerun_recording,
    set_stamp,
    true_path,
    whole_past,
)
from lidarslam.viewer.viewer import Viewer
from lidarslam.viewer.web_page import WebPage

_SCAN_COLOUR, _CLOSED_COLOUR, _LOOP_COLOUR = (240, 228, 66), (86, 180, 233), (204, 121, 167)
# The growing map is shown this far around the sensor.
_NEAR_M = 60.0
# Entity, title, and the names of its series.
_PLOTS = (
    ("ms", "ms per scan", STAGES),
    ("residual", "Residual [m]", ("median point to plane",)),
    ("inliers", "Inlier ratio", ("worst direction",)),
)


class RerunViewer(Viewer):
    """Logs a run to a Rerun recording."""

    def __init__(self, recording: rr.RecordingStream, config: ViewerConfig) -> None:
        self._recording = recording
        self._config = config
        self._last_position: FloatArray | None = None
        for plot, _, names in _PLOTS:
            recording.log(f"plots/{plot}", rr.SeriesLines(names=names), static=True)

    def wants_map(self, index: int) -> bool:
        """Whether the map is shown after this scan: at a fixed interval."""
        return index % self._config.map_every == 0

    def show_reference(self, reference: Trajectory) -> None:
        """The whole true path, at once."""
        self._recording.log("world/ground_truth", true_path(reference), static=True)

    def show_scan(self, index: int, result: ScanEstimate) -> None:
        """The scan at its pose, the next piece of the trajectory, the next value of every plot."""
        set_stamp(self._recording, index, result.stamp)
        T = result.T_world_lidar
        self._recording.log("world/lidar", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        points = every_nth(result.points, self._config.scan_points)
        self._recording.log("world/lidar/scan", rr.Points3D(points, colors=[_SCAN_COLOUR], radii=SCAN_RADIUS))
        self._log_path(T[:3, 3], result.status)
        self._recording.log("plots/ms", rr.Scalars([result.stage_ms.get(stage, 0.0) for stage in STAGES]))
        for plot, value in (("residual", result.residual_m), ("inliers", result.inlier_ratio)):
            if value is not None:
                self._recording.log(f"plots/{plot}", rr.Scalars(value))
        if result.message:
            level = rr.TextLogLevel.ERROR if result.status is Status.LOST else rr.TextLogLevel.WARN
            self._recording.log("log", rr.TextLog(result.message, level=level))

    def show_map(self, points: FloatArray) -> None:
        """The part of the map around the sensor."""
        if self._last_position is not None:
            points = points[np.linalg.norm(points - self._last_position, axis=1) < _NEAR_M]
        self.show_final_map(points)

    def show_final_map(self, points: FloatArray) -> None:
        """All of the map, coloured by height."""
        log_map(self._recording, "world/map", points, self._config.map_points)

    def show_closed(self, positions: FloatArray, loops: Sequence[tuple[int, int]]) -> None:
        """The corrected path next to the one before, and the loops."""
        path = rr.LineStrips3D([positions], colors=[_CLOSED_COLOUR], radii=PATH_RADIUS, labels=["loops closed"])
        self._recording.log("world/closed/trajectory", path)
        pairs = positions[np.array(loops, dtype=np.intp).reshape(-1, 2)]
        self._recording.log(
            "world/closed/loops", rr.LineStrips3D(list(pairs), colors=[_LOOP_COLOUR], radii=PATH_RADIUS)
        )

    def _log_path(self, position: FloatArray, status: Status) -> None:
        """Only the newest piece: the view shows all pieces up to the present, so the recording grows linearly."""
        if self._last_position is not None:
            piece = np.stack([self._last_position, position])
            line = rr.LineStrips3D([piece], colors=[STATUS_COLOURS[status]], radii=PATH_RADIUS)
            self._recording.log("world/trajectory", line)
        self._last_position = position.copy()


@contextlib.contextmanager
def rerun_viewer(
    name: str, config: ViewerConfig, path: Path, window: bool = False, page: WebPage | None = None
) -> Iterator[RerunViewer]:
    """A viewer that writes the recording `path`, and shows it in a window or on a page too if asked for."""
    if window:
        open_window(GRPC_PORT)
    with (
        contextlib.ExitStack() as shown,
        rerun_recording(name, path, rr.GrpcSink() if window else None, _blueprint()) as recording,
    ):
        if page is not None:
            shown.enter_context(page.showing(path))
        yield RerunViewer(recording, config)


def _blueprint() -> rrb.Blueprint:
    """A 3D view next to time series; the other panels are folded."""
    space = rrb.Spatial3DView(
        origin="/world",
        name="Trajectory and map",
        background=BACKGROUND,
        overrides={"world/trajectory": [rrb.VisibleTimeRanges(whole_past())]},
    )
    plots = [rrb.TimeSeriesView(origin=f"/plots/{plot}", name=title) for plot, title, _ in _PLOTS]
    messages = rrb.TextLogView(origin="/log", name="Messages")
    return rrb.Blueprint(
        rrb.Horizontal(space, rrb.Vertical(*plots, messages), column_shares=[3, 1]),
        rrb.TimePanel(timeline=SCAN, play_state="following", state="collapsed"),
        collapse_panels=True,
    )
