"""What a run shows while it works; a run without a window uses `NullViewer`."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Literal, Protocol

from lidarslam.config.settings import ViewerConfig
from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.estimates import ScanResult
from lidarslam.run import directory as files
from lidarslam.run.directory import RunDirectory
from lidarslam.run.scan_log import ScanLog

RerunMode = Literal["off", "save", "spawn"]


class Viewer(Protocol):
    """Watches a run; nothing it is shown is changed."""

    def wants_map(self, index: int) -> bool:
        """Whether `show_map` should be called after the scan with this index."""

    def show_reference(self, reference: Trajectory) -> None:
        """The true trajectory, in the run's world."""

    def show_scan(self, index: int, result: ScanResult) -> None:
        """One scan and what became of it."""

    def show_map(self, points: FloatArray) -> None:
        """The points (N, 3) of the map so far, in the world."""

    def show_final_map(self, points: FloatArray) -> None:
        """The points (N, 3) of the map as it is written, in place of those so far."""

    def show_closed(self, positions: FloatArray, loops: Sequence[tuple[int, int]]) -> None:
        """Where all scans (N, 3) are once loops are closed, and between which scans these are."""

    def close(self) -> None:
        """The run is over; everything shown is kept."""


class NullViewer:
    """Shows nothing."""

    def wants_map(self, index: int) -> bool:  # noqa: ARG002
        """Never."""
        return False

    def show_reference(self, reference: Trajectory) -> None:
        """Nothing."""

    def show_scan(self, index: int, result: ScanResult) -> None:
        """Nothing."""

    def show_map(self, points: FloatArray) -> None:
        """Nothing."""

    def show_final_map(self, points: FloatArray) -> None:
        """Nothing."""

    def show_closed(self, positions: FloatArray, loops: Sequence[tuple[int, int]]) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


@contextmanager
def viewing(
    mode: RerunMode, name: str, config: ViewerConfig, directory: RunDirectory, log: ScanLog
) -> Iterator[Viewer]:
    """The viewer of a run; its recording takes its name in the run directory when all is shown.

    Args:
        mode: no Rerun recording, one in the run directory, or one there and a window.
        name: of the recording that is run.
        config: of the viewer.
        directory, log: of the run.
    """
    if mode == "off":
        yield NullViewer()
        return
    from lidarslam.viewer.rerun_viewer import IncompleteRecordingError, RerunViewer, require_complete

    try:
        with directory.replacing(files.RERUN) as path:
            viewer = RerunViewer(name, config, path, mode == "spawn")
            try:
                yield viewer
            finally:
                viewer.close()
            require_complete(path)
    except IncompleteRecordingError as error:  # it costs the picture of the run, not the run
        log.warn(f"no {files.RERUN}: {error}")
