"""Time of the points in the clouds of a bag's topic: by their time field, or by their azimuth."""

from collections.abc import Iterator
from functools import cached_property
from itertools import islice

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.recording import Topic
from lidarslam.datasets.ros import livox
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.ros.bag_message import VELODYNE_SCAN_TYPE, BagMessage, StampSource
from lidarslam.datasets.ros.point_cloud2 import DecodedCloud
from lidarslam.datasets.ros.timed_scan import field_offsets
from lidarslam.datasets.times.azimuth import AZIMUTH_TIME, AzimuthTiming, Sweep, infer_azimuth_timing, time_warnings
from lidarslam.datasets.times.point_time import LearnedTime, PointTimeModel, TimedCloud, is_return, learn_point_time

# So many pairs of messages, spread over the first so many, are compared at their seams.
_PAIRS, _LOOKED_AT = 40, 600


class BagPointTime:
    """Inferred once, so that all scans are read alike."""

    def __init__(
        self, bag: BagFile, topic: Topic, config: ReaderConfig, stamps: StampSource, period_s: float | None
    ) -> None:
        self._bag = bag
        self._topic = topic
        self._config = config
        self._stamps = stamps
        self._period_s = period_s

    @property
    def model(self) -> PointTimeModel | None:
        """What the offsets come from; None where points have no times."""
        return self._field if self.azimuth.period_s is None else AZIMUTH_TIME

    def offsets(self, cloud: DecodedCloud, stamp: float) -> FloatArray | None:
        """Seconds (N,) from the stamp; None where this cloud has no times."""
        if self._field is None:
            return self.azimuth.offsets(Sweep(cloud.points, cloud.rings))
        return field_offsets(cloud, self._field, stamp)

    @property
    def notes(self) -> tuple[str, ...]:
        """Facts for the user."""
        return () if self.azimuth.note is None else (self.azimuth.note,)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with the times, and times that could follow from the azimuth."""
        return time_warnings(self._learned, self.azimuth)

    @property
    def _field(self) -> PointTimeModel | None:
        return self._learned.model

    @cached_property
    def _learned(self) -> LearnedTime:
        unit, reference = self._config.time_unit, self._config.time_reference
        if reference == "none":
            return LearnedTime()
        if self._topic.message_type == VELODYNE_SCAN_TYPE:
            unit, reference = "ns", "absolute"  # as they are decoded
        elif self._topic.message_type in livox.CUSTOM_MESSAGE_TYPES:
            return learn_point_time(self._timed_clouds(), unit, "absolute", self._period_s, livox.TIME_UNIT)
        return learn_point_time(self._timed_clouds(), unit, reference, self._period_s)

    @cached_property
    def azimuth(self) -> AzimuthTiming:
        """Whether the times follow from the azimuth."""
        if self._field is not None:
            return AzimuthTiming()
        return infer_azimuth_timing(self._pairs(), self._period_s, self._config.time_reference)

    def _timed_clouds(self) -> Iterator[TimedCloud]:
        for message in self._sound():
            if (cloud := self._decoded(message)) is not None:
                times = None if cloud.times is None else cloud.times[is_return(cloud.points)]
                yield TimedCloud(cloud.time_field, times, self._stamps.stamp(message))

    def _pairs(self) -> Iterator[list[Sweep]]:
        apart = max(2, min(self._topic.messages, _LOOKED_AT) // _PAIRS)
        pair: list[Sweep] = []
        for number, message in enumerate(islice(self._sound(), _LOOKED_AT)):
            if number % apart < 2 and (cloud := self._decoded(message)) is not None:
                pair.append(Sweep(cloud.points, cloud.rings))
            if number % apart == 1:
                yield pair
                pair = []

    def _decoded(self, message: BagMessage) -> DecodedCloud | None:
        """The cloud; None of a damaged one, which is counted when it is its turn."""
        try:
            return self._bag.decode(message, self._config.time_field)
        except InputError:
            return None

    def _sound(self) -> Iterator[BagMessage]:
        return (message for message in self._bag.messages(self._topic) if message.damage is None)
