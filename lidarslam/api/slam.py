"""SLAM in a program's own loop, one scan after the other, from arrays that are checked before they are used."""

import copy
import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from threading import RLock
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import ThreadpoolController

from lidarslam.config.settings import Config, make_config
from lidarslam.core.errors import ConfigError, InputError, LidarSlamError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import look_at
from lidarslam.datasets.mounting import corrected, transform_of
from lidarslam.mapping.global_map.point_cloud import PointCloud
from lidarslam.pipeline.compile_ahead import CompileAhead, parts_of
from lidarslam.pipeline.estimates import ScanEstimate
from lidarslam.pipeline.localisation import make_localiser
from lidarslam.pipeline.pipeline import Pipeline, map_error
from lidarslam.run.calibration import make_imu_stream
from lidarslam.run.loop_closing import GraphOutcome, begin_graph, correct
from lidarslam.run.results import Tracked, TrackedScans, corrected_map, write_results
from lidarslam.run.run import draw_report, open_odometry
from lidarslam.run.summary import ScanLog
from lidarslam.storage.directory import RunDirectory

logger = logging.getLogger(__name__)


class Slam:
    """Estimates the pose of each scan as it comes, and builds the map in the background.

    A context manager: `close` ends its threads. Methods may be called from several threads; one waits for the other.
    The first one on a machine compiles loops before it is ready, so that no scan has to wait for them.

    Args:
        config: the path of a YAML file, or the name of one that comes with the program; settings such as
            `{"odometry.method": "kiss-icp"}` or `{"pose_graph": {"enabled": True}}`; or a `Config`. None: the defaults,
            as in `lidarslam run`.

    Raises:
        ConfigError: a setting does not exist or does not fit.
        InputError: the weights of the odometry are damaged.
    """

    def __init__(self, config: Config | str | PathLike[str] | Mapping[str, Any] | None = None) -> None:
        self._config = make_config(config)
        with CompileAhead(parts_of(self._config)) as compiling:
            self._odometry = open_odometry(self._config, None)
            compiling.wait(logger.info)
        self._graph = begin_graph(self._config)
        self._log, self._faults = ScanLog(), Faults()
        self._imu = make_imu_stream(self._config, self._log.warn)
        localiser = make_localiser(self._config, self._imu)
        self._pipeline = Pipeline(self._odometry, localiser, self._config.global_map, self._graph)
        self._blas = ThreadpoolController()
        self._count, self._longest_interval_s = 0, 0.0
        self._last_stamp: float | None = None
        self._counts_stamps = False  # whether stamps are made from the rate
        self._failure: BaseException | None = None
        self._closed = False
        self._lock = RLock()

    def register_frame(
        self, points: ArrayLike | Scan, point_times: ArrayLike | None = None, stamp: float | None = None
    ) -> ScanEstimate:
        """Register the next scan, and return its pose at once; the map follows in the background.

        Points that are NaN, at the origin or beyond 10 km are left out. The arrays may be used again afterwards.

        Args:
            points: (N, 3) x, y, z: metres, in the LiDAR frame (x forward, z up; others are turned by
                `reader.mounting`) of the instant each was measured at; (N, 4) with the intensity, which goes into the
                map; of more columns only x, y, z are taken. Or a `Scan` in that frame, which has times and stamp of its
                own and the attributes that go into maps, and which the settings of the reader leave as it is.
            point_times: (N,) seconds from the stamp at which each point was measured; None when the points are
                motion compensated, or the times unknown.
            stamp: seconds, after that of the scan before; the pose belongs to this instant. None, then for all scans:
                they come at `reader.rate_hz`, 10 Hz unless it is configured.

        Raises:
            InputError: an array or the stamp is not as described. Nothing has changed; continue with the next scan.
            LidarSlamError: registration is not possible any more, or this object is closed.
        """
        with self._entered():
            self._require_working()
            started = time.perf_counter()
            scan = self._take(points, point_times, stamp)
            if self._imu is not None:
                scan = self._imu.take_up(scan)
            try:
                with self._blas.limit(limits=1, user_api="blas"):
                    estimate = self._pipeline.register(scan, started, self._log.add)
            except BaseException as error:  # also Ctrl-C leaves the stages in different states
                self._failure = error
                raise
            return copy.deepcopy(estimate)  # the next scan's estimate begins with the original

    def register_imu(self, stamp: float, gyroscope: ArrayLike, acceleration: ArrayLike) -> None:
        """Take the next sample of the IMU; with `odometry.method` `learned+imu` or `imu`.

        A scan is registered with the samples that have come before it: give those of its sweep first. Where
        `odometry.imu_rotation_deg` is not configured, the rotation is found by the turns of the first scans.

        Args:
            stamp: seconds on the clock of the scans, after that of the sample before.
            gyroscope: (3,) angular velocity in the IMU's axes, rad/s.
            acceleration: (3,) specific force, m/s^2: about +9.8 along the axis that points up at rest.

        Raises:
            InputError: a number is not finite, or the stamp not after the last one. Nothing has changed; continue.
            ConfigError: the configured odometry uses no IMU.
        """
        self._require_open()
        if self._imu is None:
            raise ConfigError(
                f"odometry.method={self._config.odometry.method} uses no IMU; choose odometry.method=learned+imu"
            )
        vectors = make_vector("gyroscope", gyroscope), make_vector("acceleration", acceleration)
        self._imu.add(check_stamp(stamp, None), *vectors)

    def trajectory(self) -> Trajectory:
        """The poses of all scans so far, corrected by the loops that the pose graph has closed.

        Raises:
            LidarSlamError: building the map failed, or this object is closed.
        """
        with self._entered():
            self._settle()
            trajectory, graph = self._log.trajectory, self._graph if self._has_whole_graph() else None
            result = None if graph is None else graph.present()
            return trajectory if result is None else Trajectory(trajectory.stamps, result.T_world_lidar)

    def map(self) -> PointCloud:
        """The map of all scans so far, one point in a voxel, with normals; without moving objects.

        Raises:
            LidarSlamError: building the map failed, or this object is closed.
        """
        with self._entered():
            self._settle()
            tracked, closed = self._corrected()
            cloud = corrected_map(tracked, closed, self._config.global_map).cloud
            return PointCloud(np.empty((0, 3)), np.empty((0, 3))) if cloud is None else cloud

    def save(self, directory: str | PathLike[str], overwrite: bool = False) -> None:
        """Write the run directory of all scans so far, as `lidarslam run` does; more scans may follow.

        Args:
            directory: made if it is not there.
            overwrite: whether a run that is there is replaced.

        Raises:
            OutputError: the directory holds something else, or cannot be written.
            LidarSlamError: there is nothing to save, building the map failed, or this object is closed.
        """
        with self._entered():
            self._settle()
            if not self._log.table["points"].any():
                raise InputError("there is nothing to save: no scan with points was registered")
            self._log.warn(*(self._imu.warnings if self._imu is not None else ()))
            self._pipeline.map.slides.finish()
            described = {"version": version("lidarslam"), "source": None}
            with RunDirectory.create(Path(directory), overwrite) as run:
                outcome = write_results(run, self._config, described, *self._corrected())
            draw_report(Path(directory), outcome)

    def close(self) -> None:
        """End the threads, and release all resources; no other method may be called afterwards."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            try:
                self._pipeline.close()
            except Exception as error:
                if self._failure is None:
                    raise map_error(error) from error
            finally:
                self._odometry.close()
                if self._graph is not None:
                    self._graph.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take(self, points: ArrayLike | Scan, point_times: ArrayLike | None, stamp: float | None) -> Scan:
        if isinstance(points, Scan):
            if point_times is not None or stamp is not None:
                raise InputError("a Scan has times and a stamp of its own; give it alone")
            point_times, stamp = points.time_offsets, points.stamp
        counts_stamps = stamp is None
        if self._count and counts_stamps != self._counts_stamps:
            raise InputError("give a stamp with every scan or with none")
        last = self._last_stamp
        seconds = check_stamp(self._count / self._config.reader.rate_hz if stamp is None else stamp, last)
        scan = points if isinstance(points, Scan) else make_scan(points, point_times, seconds, self._config.reader)
        longest_s = 0.0 if last is None else max(self._longest_interval_s, seconds - last)
        if last is not None:
            check_sweep(scan, longest_s)
        self._count, self._counts_stamps = self._count + 1, counts_stamps
        self._last_stamp, self._longest_interval_s = seconds, longest_s
        return look_at(scan, self._faults)

    def _corrected(self) -> tuple[Tracked, GraphOutcome | None]:
        """The results so far, corrected by the closed loops, once the background is done."""
        log, built, closed = copy.deepcopy(self._log), self._pipeline.map, None
        if self._graph is not None and self._has_whole_graph() and built.global_map is not None:
            closed = correct(log, self._graph, self._graph.present(), built.global_map)
        return Tracked(TrackedScans.of(log, copy.copy(self._faults), built), built.global_map), closed

    def _has_whole_graph(self) -> bool:
        return self._graph is not None and len(self._graph.scan_poses) == len(self._log)

    def _settle(self) -> None:
        try:
            self._pipeline.settle()
        except Exception as error:
            known, self._failure = self._failure, self._failure or error
            if known is None:
                raise map_error(error) from error

    @contextmanager
    def _entered(self) -> Iterator[None]:
        with self._lock:
            self._require_open()
            yield

    def _require_open(self) -> None:
        if self._closed:
            raise LidarSlamError("this Slam is closed; call trajectory(), map() and save() before close()")

    def _require_working(self) -> None:
        if self._failure is not None:
            reason = str(self._failure) or type(self._failure).__name__
            raise LidarSlamError(
                f"an earlier scan was broken off ({reason}), and no more can be registered; trajectory(), map() and"
                " save() give what came before it"
            )


# More columns than any point has are many points.
_MOST_COLUMNS = 32
# No sweep lasts longer, and no clock reading is smaller.
_LONGEST_OFFSET_S = 10.0
# Of a cloud as KITTI stores it: x, y, z, intensity.
_WITH_INTENSITY = 4
# Larger numbers, thousands of years, are not in seconds.
_LATEST_STAMP_S = 1e11
# Stamps jitter; a sweep that is longer than this many intervals between stamps has other units.
_MOST_INTERVALS = 4.0


def make_scan(points: ArrayLike, point_times: ArrayLike | None, stamp: float, config: ReaderConfig) -> Scan:
    """A scan, of copies, in upright axes, without the invalid points: NaN, at the origin, beyond 10 km.

    Args:
        points: (N, 3) x, y, z in metres; (N, 4) with the intensity; more columns, of which only x, y, z are taken; or
            a cloud of Open3D.
        point_times: (N,) seconds from the stamp.
        stamp: seconds.
        config: mounting of the points' axes, of which auto is upright; elevation correction; scale of the times.

    Raises:
        InputError: an array has another shape, or a time is not in seconds.
    """
    table = _numbers("points", getattr(points, "points", points))
    if not table.size:
        table = np.empty((0, 3))
    if table.ndim != 2 or not 3 <= table.shape[1] <= _MOST_COLUMNS:
        raise InputError(f"points must be (N, 3), x, y, z first, got the shape {table.shape}; give points.T of (3, N)")
    times = None if point_times is None else _times(point_times, len(table))
    intensities = np.array(table[:, 3]) if table.shape[1] == _WITH_INTENSITY else None
    scan = Scan.from_raw(np.array(table[:, :3], dtype=np.float64), stamp, times, intensities=intensities)
    return corrected(scan, transform_of(config.mounting), config.raised_deg(), config.time_scale)


def make_vector(name: str, numbers: ArrayLike) -> FloatArray:
    """Three finite numbers (3,), copied; InputError where they are something else."""
    vector = np.array(_numbers(name, numbers), dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{name} must be three finite numbers, got {numbers!r}")
    return vector


def check_stamp(stamp: float, last: float | None) -> float:
    """The stamp in seconds; InputError where it is no number of seconds, or not after the last one."""
    seconds = _numbers("stamp", stamp)
    if seconds.shape or not abs(seconds) <= _LATEST_STAMP_S:
        raise InputError(f"stamp must be a finite number of seconds, got {stamp!r}; multiply nanoseconds by 1e-9")
    if last is not None and seconds <= last:
        raise InputError(
            f"stamps must increase: {seconds:.9f} s is not after the scan before, {last:.9f} s; leave it out"
        )
    return float(seconds)


def check_sweep(scan: Scan, interval_s: float) -> None:
    """Refuse a sweep that is much longer than the longest time between two stamps so far."""
    if scan.time_offsets is None or not len(scan):
        return
    sweep_s = float(np.ptp(scan.time_offsets))
    if sweep_s > _MOST_INTERVALS * interval_s:
        raise InputError(
            f"point_times span {sweep_s:.3g} s, but scans are {interval_s:.3g} s apart; expected are seconds from the"
            " stamp: multiply times from 0 to 1 by the duration of a sweep"
        )


def _times(point_times: ArrayLike, count: int) -> FloatArray:
    seconds = np.array(_numbers("point_times", point_times).reshape(-1), dtype=np.float64)
    if len(seconds) != count:
        raise InputError(f"point_times must have one entry a point, got {len(seconds)} for {count} points")
    largest = float(np.abs(seconds[np.isfinite(seconds)]).max(initial=0.0))
    if largest > _LONGEST_OFFSET_S:
        raise InputError(
            f"point_times must be seconds from the stamp, fractions of one; got up to {largest:.6g}: subtract the stamp"
            " from absolute times, and multiply nanoseconds by 1e-9, microseconds by 1e-6"
        )
    return seconds


def _numbers(name: str, values: ArrayLike) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(f"{name} must be numbers: {error}") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} must be numbers, got {array.dtype}")
    return array
