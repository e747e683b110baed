"""Viewers of a run in progress."""

from collections.abc import Sequence
from typing import Literal

from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.estimates import ScanEstimate

RerunMode = Literal["off", "save", "web", "spawn"]


class Viewer:
    """Watches a run; this one shows nothing, others override its methods."""

    def wants_map(self, index: int) -> bool:  # noqa: ARG002
        """Whether `show_map` is to be called after the scan with this index."""
        return False

    def show_reference(self, reference: Trajectory) -> None:
        """The true trajectory, in the run's world."""

    def show_scan(self, index: int, result: ScanEstimate) -> None:
        """One scan."""

    def show_map(self, points: FloatArray) -> None:
        """The points (N, 3) of the map so far, in the world."""

    def show_final_map(self, points: FloatArray) -> None:
        """The points (N, 3) of the final map, in place of those so far."""

    def show_closed(self, positions: FloatArray, loops: Sequence[tuple[int, int]]) -> None:
        """The corrected positions (N, 3) of all scans, and the pairs of scans that loops were closed between."""
