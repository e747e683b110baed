"""ROS 2 messages of a live run: clouds that become scans, and odometry and transforms to be published."""

from collections.abc import Callable
from dataclasses import dataclass

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, adjoint, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.mounting import corrected, transform_of
from lidarslam.datasets.point_table import RawCloud
from lidarslam.datasets.ros import bag_message
from lidarslam.datasets.ros import made_messages as made
from lidarslam.datasets.ros.bag_message import BagMessage, decode, read_header, serialize, typestore
from lidarslam.datasets.sweeps import LOOKED_AT_S, Directions, SweepJoiner, directions_of, scans_of_a_sweep
from lidarslam.datasets.times.azimuth import PointTiming
from lidarslam.datasets.times.point_time import CLOCK_LIMIT_S, learn_point_time
from lidarslam.pipeline.estimates import ScanEstimate

# Clouds that the meaning of the time field is inferred from: the first that is unambiguous settles it.
_MOST_LOOKED_AT = 10

# A stamp that is ahead of the time since the scan before by this much is an outlier, unless this many in a row are.
_AHEAD_NS, _CLOCK_WAS_SET = 10**9, 6

# Stamps this far behind are of a clock that was set back if this many increase in a row.
_BEHIND_NS, _SET_BACK = 10**9, 6

# Share of a sweep by which stamps may be early.
_JITTER = 0.1

_NOT_AFTER = "scans were left out: their stamps are not after those of the scans before"
_AHEAD = "scans were left out: their stamps are ahead of the time that has passed since the scans before"
_CLOCK_BEHIND = "scans are behind the last one: the clock of the stamps was set back, and the run ended; start another"
_OTHER_SENSOR = "scans were left out: they come from another sensor; name one with --set reader.frame_id=NAME"

_TIME_FIELD = "time field of the points has a fault"


@dataclass(frozen=True, eq=False)
class LiveScan:
    """A scan with the header of its message."""

    scan: Scan  # in upright axes
    stamp_ns: int  # of the header, or of the publication where the header has none
    frame_id: str  # the sensor's frame


class CloudDecoder:
    """Scans from the messages of one topic, in the order of their stamps.

    The sensor is that of the first message unless `reader.frame_id` names one, and unit and reference of the point
    times are inferred from the first messages, as for a bag. Without `reader.mounting` the axes stay as they are. Parts
    of sweeps are joined after the first half second, or from the first scan on where `reader.sweep_s` is set.
    """

    def __init__(self, config: ReaderConfig, message_type: str, faults: Faults) -> None:
        self._config = config
        self._type = message_type
        self._faults = faults
        self._frame_id = config.frame_id
        self._last_ns: int | None = None
        self._last_published_ns = self._ahead = 0  # and the number of stamps in a row ahead of it
        self._behind_ns, self._behind = 0, 0  # the last stamp behind it, and the number of increasing ones in a row
        self._has_header_stamps = True
        self._clouds: list[tuple[RawCloud, float]] = []
        self._timing = PointTiming()
        self._is_settled = config.time_reference == "none"
        self.T_upright_recorded = transform_of(config.mounting)
        self._first: list[Directions] | None = []  # until it is known whether they are joined
        self._joiner: SweepJoiner | None = None
        self._stamps_ns: dict[float, int] = {}  # of the scans that it holds, by their stamps in seconds

    @property
    def is_set_back(self) -> bool:
        """Whether the clock of the stamps was set back, so that no later scan follows the earlier ones."""
        return self._behind >= _SET_BACK

    def scan(self, raw: bytes, published_ns: int) -> LiveScan | None:
        """The scan of a serialised message, or the sweep that was complete before it.

        None where the message cannot be used, which is counted, or where it continues a sweep.
        """
        try:
            header_ns, frame_id = read_header(raw, ros2=True)
            if self._last_ns is None:  # the first one decides
                self._has_header_stamps = header_ns != 0
            stamp_ns = header_ns if self._has_header_stamps else published_ns
            if not self._is_wanted(stamp_ns, published_ns, frame_id):
                return None
            message = BagMessage(published_ns, header_ns, frame_id, self._type, raw)
            cloud = decode(message, True, self._config.time_field)
        except Exception as error:  # of a message that breaks off: an assertion, struct.error, IndexError
            self._faults.unreadable(InputError(str(error) or type(error).__name__))
            return None
        stamp = stamp_ns / 10**9
        self._learn(cloud, stamp)
        self._last_ns, self._last_published_ns, self._frame_id = stamp_ns, published_ns, frame_id
        self._ahead = self._behind = 0
        scan = self._timing.scan(cloud, stamp, self._faults, f"{stamp:.9f}")
        scan = corrected(scan, self.T_upright_recorded, self._config.raised_deg(), self._config.time_scale)
        return self._joined(LiveScan(scan, stamp_ns, frame_id))

    def _joined(self, live: LiveScan) -> LiveScan | None:
        """The scan, or where scans hold a part of a sweep, the sweep that was complete before it."""
        if self._joiner is None:
            if not (sweep_s := self._sweep_s(live.scan)):
                return live
            self._joiner = SweepJoiner(sweep_s, _JITTER * sweep_s, live.scan.stamp)
        sweep = self._joiner.add(live.scan)
        done = None if sweep is None else LiveScan(sweep, self._stamps_ns[sweep.stamp], live.frame_id)
        if done is not None:
            self._stamps_ns.clear()
        self._stamps_ns[live.scan.stamp] = live.stamp_ns
        return done

    def _sweep_s(self, scan: Scan) -> float:
        """The duration of a sweep to which scans are joined, as set or as the first ones show; else 0."""
        if isinstance(self._config.sweep_s, float):
            return self._config.sweep_s
        if self._first is None:
            return 0.0
        self._first.append(directions_of(scan))
        span_s = scan.stamp - self._first[0][0]
        if span_s < LOOKED_AT_S:
            return 0.0
        period_s = span_s / (len(self._first) - 1)
        scans, self._first = scans_of_a_sweep(self._first, period_s), None
        return scans * period_s if scans > 1 else 0.0

    def _is_wanted(self, stamp_ns: int, published_ns: int, frame_id: str) -> bool:
        if self._frame_id is not None and frame_id != self._frame_id:
            self._faults.leave_out(_OTHER_SENSOR, f"{frame_id!r} instead of {self._frame_id!r}")
            return False
        # At the beginning the publication takes the place of a scan before; a clock that is behind it is another one.
        last_ns = min(stamp_ns - 1, published_ns) if self._last_ns is None else self._last_ns
        waited_ns = 0 if self._last_ns is None else max(0, published_ns - self._last_published_ns)
        example = f"{stamp_ns / 10**9:.9f}, after {last_ns / 10**9:.9f}"
        if stamp_ns <= last_ns:
            self._behind = self._behind + 1 if self._behind_ns < stamp_ns < last_ns - _BEHIND_NS else 0
            self._behind_ns = stamp_ns
            if self.is_set_back:
                self._faults.note(_CLOCK_BEHIND, example, self._behind)
            self._faults.leave_out(_NOT_AFTER, example)
            return False
        self._ahead = self._ahead + 1 if stamp_ns - last_ns > waited_ns + _AHEAD_NS else 0
        if 0 < self._ahead < _CLOCK_WAS_SET:
            self._faults.leave_out(_AHEAD, example)
            return False
        return True

    def _learn(self, cloud: RawCloud, stamp: float) -> None:
        """Infer unit and reference of the time field, until they are clear."""
        if self._is_settled:
            return
        unit, reference, defined_unit = self._config.time_unit, self._config.time_reference, None
        if self._type in bag_message.CUSTOM_MESSAGE_TYPES:
            reference, defined_unit = "absolute", bag_message.TIME_UNIT
        self._clouds.append((cloud, stamp))
        before = len(self._clouds) - 1
        period_s = (stamp - self._clouds[0][1]) / before if before else None
        learned = learn_point_time(self._clouds, unit, reference, period_s, defined_unit)
        self._timing = PointTiming(learned.model)
        is_clear = learned.model is not None and stamp > 2 * CLOCK_LIMIT_S
        self._is_settled = is_clear or len(self._clouds) == _MOST_LOOKED_AT
        if self._is_settled:
            self._clouds.clear()
            if learned.warning is not None:
                self._faults.note(_TIME_FIELD, learned.warning)


Publish = Callable[[bytes], None]


class PosePublisher:
    """Publishes the pose of a body that carries the LiDAR, relative to the pose of the body at the first scan.

    The pose of a lost scan is a prediction, and is not published. Messages are nav_msgs/Odometry and, where there is a
    publisher for them, tf2_msgs/TFMessage.
    """

    def __init__(
        self, odometry: Publish, transforms: Publish | None, fixed_frame: str, body_frame: str, T_body_lidar: FloatArray
    ) -> None:
        self._odometry, self._transforms = odometry, transforms
        self._fixed_frame, self._body_frame = fixed_frame, body_frame
        self._T_body_lidar = T_body_lidar

    def publish(self, stamp_ns: int, estimate: ScanEstimate) -> None:
        if estimate.status is Status.LOST:
            return
        # With A the adjoint of T_body_lidar, an error or velocity xi of the LiDAR is A xi of the body.
        T = self._T_body_lidar @ estimate.T_world_lidar @ inverse(self._T_body_lidar)
        A, store = adjoint(self._T_body_lidar), typestore(ros2=True)
        covariance = None if estimate.covariance is None else A @ estimate.covariance @ A.T
        velocity = None if estimate.velocity is None else A @ estimate.velocity
        header = made.header(store, stamp_ns, self._fixed_frame)
        message = made.odometry(store, header, self._body_frame, T, covariance, velocity)
        self._odometry(serialize(message, ros2=True))
        if self._transforms is not None:
            self._transforms(serialize(made.transforms(store, (header, self._body_frame, T)), ros2=True))
