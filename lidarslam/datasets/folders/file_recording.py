"""Recordings with a file for each scan: the common part of the KITTI readers and of scan folders."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults, first_readable, readable_scans
from lidarslam.datasets.folders.scan_files import KITTI_FIELDS, scan_indices
from lidarslam.datasets.imu_samples import summarise
from lidarslam.datasets.recording import PointField, RecordingInfo
from lidarslam.datasets.times.point_time import PointTimeModel


class FileRecording:
    """A folder of scans; implements `Recording`. A reader adds `_read`, stamps, and a truth if there may be one."""

    reader: str
    imu_name: str = "imu"
    stamps: FloatArray
    """(N,) seconds."""

    def __init__(self, folder: Path, config: ReaderConfig, files: Sequence[Path]) -> None:
        self._folder = folder
        self._config = config
        self._files = files

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._folder.resolve().name

    @property
    def T_cam_lidar(self) -> FloatArray | None:
        """No camera."""
        return None

    @property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar at the truth's own stamps."""
        return None

    @property
    def imu(self) -> ImuSamples | None:
        """The samples of the IMU beside the LiDAR."""
        return None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Faults of the recording as a whole."""
        return ()

    def __len__(self) -> int:
        return len(self._files)

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; see `Recording`."""
        counted = Faults() if faults is None else faults
        indices = scan_indices(len(self), start, stop, step)
        return readable_scans(indices, lambda index: self._read(index, counted), faults)

    def describe(self) -> RecordingInfo:
        """By the first readable scan; see `Recording`."""
        faults = Faults()
        index, first, unreadable = first_readable(self._folder, range(len(self)), lambda i: self._read(i, faults))
        return RecordingInfo(
            reader=self.reader,
            scans=len(self),
            first=first,
            last_stamp=self._last_stamp(),
            ground_truth=self._truth_path(),
            point_time=self._point_time_model(),
            fields=self._fields(index),
            notes=(*self._notes(), *self.warnings, *unreadable.warnings()),
            rate_is_assumed=self._rate_is_assumed,
            imu=summarise(self.imu_name, self.imu),
        )

    @property
    def _rate_is_assumed(self) -> bool:
        """Whether the stamps follow from the rate of the settings."""
        return False

    def _read(self, index: int, faults: Faults) -> Scan:
        raise NotImplementedError

    def _last_stamp(self) -> float:
        return float(self.stamps[-1])

    def _truth_path(self) -> Path | None:
        return None

    def _point_time_model(self) -> PointTimeModel | None:
        return None

    def _fields(self, index: int) -> tuple[PointField, ...]:  # noqa: ARG002
        return tuple(PointField(name, "float32") for name in KITTI_FIELDS)

    def _notes(self) -> Iterator[str]:
        return iter(())
