"""Recordings of packets: the common part of their readers."""

import sys
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, read_tum
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.folders.layout import find_truth_file
from lidarslam.datasets.folders.scan_files import scan_indices
from lidarslam.datasets.imu_samples import summarise
from lidarslam.datasets.recording import PointField, RecordingInfo, Topic
from lidarslam.datasets.times.point_time import PointTimeModel


class PacketRecording:
    """The sweeps of one sensor; implements `Recording`. A reader adds `_sweeps`, `_count_and_end` and `_fields`."""

    T_cam_lidar: FloatArray | None = None  # no camera
    point_time: PointTimeModel
    topic: str | None = None
    imu_name = "the sensor's own"
    topics: tuple[Topic, ...] = ()

    def __init__(self, source: Path, config: ReaderConfig) -> None:
        self._source = source
        self._config = config
        folders = [source, source.resolve().parent] if source.is_dir() else [source.parent]
        self._truth_file = find_truth_file(folders, self.name)

    @property
    def name(self) -> str:
        """The file's name without its suffix, or the folder's."""
        return self._source.resolve().name if self._source.is_dir() else self._source.stem

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """The TUM file beside the recording, named like it or ground_truth.tum."""
        return None if self._truth_file is None else read_tum(self._truth_file)

    @property
    def imu(self) -> ImuSamples | None:
        """The sensor's own IMU; None where it has none."""
        return None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Faults of the recording as a whole."""
        return ()

    def __len__(self) -> int:
        return self._extent[0]

    def scans(
        self,
        start: int = 0,
        stop: int | None = None,
        step: int = 1,
        faults: Faults | None = None,  # noqa: ARG002
    ) -> Iterator[Scan]:
        """The sweeps with the indices of `range(start, stop, step)`; see `Recording`."""
        return self._sweeps(scan_indices(sys.maxsize, start, stop, step))

    def describe(self) -> RecordingInfo:
        """By the first sweep; see `Recording`."""
        first = next(self._sweeps(range(1)), None)
        if first is None:
            raise InputError(f"{self._source}: holds no sweep that could be used; record it again")
        return RecordingInfo(
            reader="rosbag" if self.topics else "packets",
            scans=len(self),
            first=first,
            last_stamp=self._extent[1],
            ground_truth=self._truth_file,
            point_time=None if first.time_offsets is None else self.point_time,
            topic=self.topic,
            topics=self.topics,
            fields=self._fields(),
            notes=(*self._notes(), *self.warnings),
            imu=summarise(self.imu_name, self.imu),
        )

    @cached_property
    def _extent(self) -> tuple[int, float]:
        """Number of sweeps, and the stamp of the last one."""
        raise NotImplementedError

    def _sweeps(self, wanted: range) -> Iterator[Scan]:
        """The sweeps with these indices, as many as there are."""
        raise NotImplementedError

    def _fields(self) -> tuple[PointField, ...]:
        raise NotImplementedError

    def _notes(self) -> Iterator[str]:
        return iter(())

    def _offsets(self, offsets: FloatArray) -> FloatArray | None:
        return None if self._config.time_reference == "none" else offsets
