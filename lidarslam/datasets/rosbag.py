"""Point clouds of a rosbag: rosbag1, rosbag2 (SQLite or MCAP), as PointCloud2 or Livox CustomMsg."""

import logging
from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import read_tum
from lidarslam.datasets import livox
from lidarslam.datasets.bag_file import BagFile, BagMessage
from lidarslam.datasets.bag_stamps import StampSource, find_stamp_source
from lidarslam.datasets.bag_topics import choose_topic
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.point_cloud2 import DecodedCloud
from lidarslam.datasets.point_time import CLOCK_LIMIT_S, PointTimeModel, infer_point_time
from lidarslam.datasets.recording import PointTime, Recording, RecordingInfo
from lidarslam.datasets.scan_files import scan_indices
from lidarslam.datasets.truth_files import find_truth_file

logger = logging.getLogger(__name__)

# How many messages are looked at to learn what the points' times mean, and how many of them may not tell.
_CLOUDS_LOOKED_AT = 30
_CLOUDS_WITHOUT_TIME = 3


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a rosbag1 `.bag`, a rosbag2 folder, or a single `.db3` or `.mcap`.

    Raises:
        InputError: the bag cannot be read, or it does not hold the one point cloud topic that is asked for.
    """
    return BagRecording(source, config)


class BagRecording:
    """The messages of one point cloud topic; implements `Recording`.

    Stamps are those of the message headers, or, where no header has one, the times of recording.
    """

    def __init__(self, source: Path, config: ReaderConfig) -> None:
        self._source = source
        self._config = config
        self._bag = BagFile(source)
        self._topic = choose_topic(source, self._bag.topics, config.topic)
        self._is_livox = self._topic.message_type in livox.CUSTOM_MESSAGE_TYPES
        folders = [source, source.resolve().parent] if source.is_dir() else [source.parent]
        self._truth_file = find_truth_file(folders, self.name)

    @property
    def name(self) -> str:
        """The name of the folder, or of the file without its suffix."""
        return self._source.resolve().name if self._source.is_dir() else self._source.stem

    @property
    def T_cam_lidar(self) -> FloatArray | None:
        """A bag is read in the LiDAR frame alone."""
        return None

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """The TUM file beside the bag, or inside its folder, named like the bag or ground_truth.tum.

        Raises:
            InputError: the file is damaged.
        """
        return None if self._truth_file is None else read_tum(self._truth_file)

    def __len__(self) -> int:
        return self._topic.messages

    def scans(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; only they are decoded.

        A message whose stamp is not after those before it keeps its index but makes no scan; such messages are
        counted in a warning.

        Raises:
            InputError: the range makes no sense, or the bag is damaged.
        """
        return self._scans(scan_indices(len(self), start, stop, step))

    def _scans(self, wanted: range) -> Iterator[Scan]:
        latest, skipped = self._stamps.before_first, 0
        try:
            for index, message in enumerate(islice(self._messages(), max(0, wanted.stop))):
                stamp = self._stamps.stamp(message)
                if stamp <= latest:
                    skipped += 1
                    continue
                latest = stamp
                if index in wanted:
                    yield self._scan(message, stamp)
        finally:
            if skipped:
                logger.warning("%s: %d scans skipped, their stamps are not after those before", self._source, skipped)

    def _messages(self) -> Iterator[BagMessage]:
        count = 0
        for message in self._bag.messages(self._topic):
            count += 1
            yield message
        if not count:
            raise InputError(
                f"{self._source}: its index lists {len(self)} messages of {self._topic.name}, it holds none;"
                " reindex it, or give one of its .db3 or .mcap files instead of the folder"
            )
        if count < len(self):
            logger.warning("%s: its index lists %d scans, it holds %d", self._source, len(self), count)

    def _decode(self, message: BagMessage) -> DecodedCloud:
        return self._bag.decode(message, self._config.time_field)

    def _scan(self, message: BagMessage, stamp: float) -> Scan:
        cloud, model = self._decode(message), self._point_time
        offsets = None
        if model is not None and cloud.times is not None and cloud.time_field == model.field:
            offsets = model.offsets(cloud.times, stamp)
        return Scan.from_raw(cloud.points, stamp, offsets, cloud.rings)

    @cached_property
    def _stamps(self) -> StampSource:
        return find_stamp_source(self._bag.messages(self._topic))

    @cached_property
    def _last_stamp(self) -> float | None:
        last = self._bag.last_message(self._topic)
        return None if last is None else self._stamps.stamp(last)

    @cached_property
    def _point_time(self) -> PointTimeModel | None:
        """Inferred once, so that all scans are read alike, from the first scan that leaves no doubt.

        Stamps close to zero leave doubt: times from 0 to 0.1 s are then relative as well as absolute.
        """
        if self._config.time_reference == "none":
            return None
        model, failures, period_s = None, 0, None
        for message in islice(self._bag.messages(self._topic), _CLOUDS_LOOKED_AT):
            stamp = self._stamps.stamp(message)
            if period_s is None and self._last_stamp is not None and len(self) > 1:
                period_s = (self._last_stamp - stamp) / (len(self) - 1)
            found = self._infer(self._decode(message), stamp, period_s)
            model = found or model
            failures += found is None
            if (found is not None and stamp > 2 * CLOCK_LIMIT_S) or failures == _CLOUDS_WITHOUT_TIME:
                break
        return model

    def _infer(self, cloud: DecodedCloud, stamp: float, period_s: float | None) -> PointTimeModel | None:
        if cloud.time_field is None or cloud.times is None:
            return None
        times = cloud.times[_returns(cloud)]
        if self._is_livox:  # the message type says what its times are
            return infer_point_time(cloud.time_field, times, stamp, livox.TIME_UNIT, "absolute")
        config = self._config
        return infer_point_time(cloud.time_field, times, stamp, config.time_unit, config.time_reference, period_s)

    def describe(self) -> RecordingInfo:
        """What `lidarslam info` prints.

        Raises:
            InputError: the bag is damaged, or none of its messages makes a scan.
        """
        first = next(self.scans(), None)
        message = next(self._messages(), None)
        if first is None or message is None:
            raise InputError(f"{self._source}: no message of {self._topic.name} makes a scan")
        cloud = self._decode(message)
        duration_s = max(0.0, (self._last_stamp or first.stamp) - first.stamp)
        return RecordingInfo(
            reader="rosbag",
            scans=len(self),
            first_stamp=first.stamp,
            duration_s=duration_s,
            rate_hz=(len(self) - 1) / duration_s if duration_s > 0.0 else None,
            points_per_scan=len(first),
            dropped_points=first.dropped,
            has_rings=first.rings is not None,
            ground_truth=self._truth_file,
            point_time=self._describe_point_time(first),
            topic=self._topic.name,
            topics=self._bag.topics,
            fields=cloud.fields,
            notes=tuple(self._notes(cloud, self._stamps.stamp(message))),
        )

    def _describe_point_time(self, scan: Scan) -> PointTime | None:
        model, offsets = self._point_time, scan.time_offsets
        if model is None or offsets is None or not len(offsets):
            return None
        return PointTime(model.field, model.unit, model.reference, float(offsets.min()), float(offsets.max()))

    def _notes(self, cloud: DecodedCloud, stamp: float) -> Iterator[str]:
        if not self._stamps.from_header:
            yield "The message headers have no stamps, so the times of recording are used."
        if cloud.time_field is None or cloud.times is None:
            return
        if self._point_time is None:
            if self._config.time_reference != "none":
                yield f"The point field {cloud.time_field} holds no usable time."
        elif not self._point_time.shares_clock(cloud.times, stamp):
            yield (
                f"The point field {cloud.time_field} reads another clock than the stamps,"
                " so the earliest point of each scan gets the scan's stamp."
            )


def _returns(cloud: DecodedCloud) -> NDArray[np.bool_]:
    """Mask of the points that are returns of the laser; drivers leave any time they like in the others."""
    return np.asarray(np.isfinite(cloud.points).all(axis=1) & cloud.points.any(axis=1))
