"""Recordings of packets: the common part of their readers, and the libraries that decode packets."""

import sys
from collections.abc import Iterator
from functools import cached_property
from importlib import import_module
from pathlib import Path

from lidarslam.core.errors import ConfigError
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.stored_recording import StoredRecording, scan_indices, truth_beside
from lidarslam.datasets.times.point_time import PointTimeModel

# The commands to install them. ouster-sdk is no extra: it requires a version of rosbags that this program cannot use,
# and does not need it for the functions used here.
_INSTALL = {
    "velodyne_decoder": "pip install 'lidarslam[velodyne]'",
    "ouster.sdk": "pip install --no-deps ouster-sdk",
}


def require(library: str, purpose: str) -> None:
    """Check that a library is installed; the message names the purpose."""
    try:
        import_module(library)
    except ModuleNotFoundError as error:
        name = library.partition(".")[0] if error.name and library.startswith(error.name) else error.name
        raise ConfigError(f"{name} is not installed, which {purpose} need; {_INSTALL[library]}") from error


class PacketRecording(StoredRecording):
    """The sweeps of one sensor. A reader adds `_extent`, `_items`, `_read` and `_fields`."""

    reader = "packets"
    imu_name = "the sensor's own"
    library: tuple[str, str]  # that decodes the packets, and whose packets
    point_time: PointTimeModel

    def __init__(self, source: Path, config: ReaderConfig) -> None:
        require(*self.library)
        super().__init__(source, config)
        self._truth_path = truth_beside(source, self.name)
        self._has_times = config.time_reference != "none"
        self._point_time = self.point_time if self._has_times else None

    def __len__(self) -> int:
        return self._extent[0]

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """See `Recording`; sweeps are not counted beforehand, which would take a pass over all packets."""
        return self._scans(scan_indices(sys.maxsize, start, stop, step), faults)

    @cached_property
    def _extent(self) -> tuple[int, float]:
        """Number of sweeps, and the stamp of the last one."""
        count, last = 0, 0.0
        for scan in self.scans(faults=Faults()):
            count, last = count + 1, scan.stamp
        return count, last

    def _last_stamp(self, first: Scan) -> float:  # noqa: ARG002
        return self._extent[1]
