"""What a viewer shows of a localisation: the scans from the first place on."""

from lidarslam.core.tracking import Status
from lidarslam.pipeline.estimates import ScanResult
from lidarslam.viewer.viewer import Viewer


class PlacedViewer(Viewer):
    """Passes scans on once one has a place in the map: before, poses are in a frame of their own.

    Args:
        shown: the viewer that shows them.
    """

    def __init__(self, shown: Viewer) -> None:
        self._shown = shown
        self._is_placed = False

    def show_scan(self, index: int, result: ScanResult) -> None:
        """One scan, if the place is known."""
        self._is_placed = self._is_placed or result.status is not Status.LOST
        if self._is_placed:
            self._shown.show_scan(index, result)
