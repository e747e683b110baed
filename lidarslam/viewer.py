"""What a run shows while it works; a run without a window uses `NullViewer`."""

from collections.abc import Sequence
from typing import Protocol

from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline import ScanResult
from mapping.global_map import GlobalMap


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

    def show_closed(self, positions: FloatArray, loops: Sequence[tuple[int, int]], global_map: GlobalMap) -> None:
        """Where all scans (N, 3) are once loops are closed, between which scans these are, and the map then."""

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

    def show_closed(self, positions: FloatArray, loops: Sequence[tuple[int, int]], global_map: GlobalMap) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""
