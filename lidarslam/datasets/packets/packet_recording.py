"""Recordings of packets: the common part of their readers, and the libraries that decode packets."""

import sys
from collections.abc import Iterator
from functools import cached_property
from importlib import import_module
from pathlib import Path

from lidarslam.core.errors import ConfigError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
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
    """Check that a library is installed; the message names the purpose.

    Raises:
        ConfigError: it is not.
    """
    try:
        import_module(library)
    except ModuleNotFoundError as error:
        name = library.partition(".")[0] if error.name and library.startswith(error.name) else error.name
        raise ConfigError(f"{name} is not installed, which {purpose} need; {_INSTALL[library]}") from error


class PacketRecording(StoredRecording):
    """The sweeps of one sensor. A reader adds `_extent`, `_items`, `_read` and `_fields`."""

    reader = "packets"
    imu_name = "the sensor's own"
    point_time: PointTimeModel

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
        raise NotImplementedError

    def _last_stamp(self, first: Scan) -> float:  # noqa: ARG002
        return self._extent[1]

    def _truth_path(self) -> Path | None:
        return truth_beside(self._source, self.name)

    def _point_time_model(self) -> PointTimeModel | None:
        return None if self._config.time_reference == "none" else self.point_time

    def _offsets(self, offsets: FloatArray) -> FloatArray | None:
        return None if self._config.time_reference == "none" else offsets
