"""What is estimated of a sensor: how its IMU is mounted, errors of clocks, elevations, and times of the points."""

import logging
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import FloatArray, inverse, log, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.text import command_line
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.mounting import elevation_of, recorded_axes, transform_of
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.registry import open_recording
from lidarslam.mapping.elevation import ElevationEstimator
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.run.request import RunRequest

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.inertial.comparison import Comparison
    from lidarslam.mapping.inertial.inertial import Inertial
    from lidarslam.pipeline.imu_stream import ImuStream

logger = logging.getLogger(__name__)

_INSTEAD = "choose --odometry learned, which needs none"
_ROTATION = "--set odometry.imu_rotation_deg=[R,P,Y]"
# Largest number of scans to find a rotation in, and the interval of the attempts.
_MOST_SCANS, _EVERY = 600, 10
# Lower rates are those of stamps in another unit; KITTI's GPS/IMU has 10 Hz.
_LEAST_RATE_HZ = 2.0
# Largest number of scans for the comparison of clock and rotation.
_COMPARED_SCANS = 60


def imu_samples(config: Config, recording: Recording) -> ImuSamples | None:
    """The samples that the odometry needs, None where it needs none; ConfigError without an IMU."""
    if not config.odometry.uses_imu:
        return None
    samples = recording.imu
    if samples is None or len(samples) < 2:
        raise ConfigError(f"{recording.name}: has no IMU, for --odometry {config.odometry.method}; {_INSTEAD}")
    return samples


def unused_imu(config: Config, recording: Recording) -> str | None:
    """A hint at an IMU in the recording that the odometry does not use; None without one."""
    if config.odometry.uses_imu or not config.mapping.enabled or recording.describe().imu is None:
        return None
    return "the recording has an IMU that is not used; --odometry learned+imu uses it"


def open_inertial(
    config: Config, recording: Recording, chosen: range, warn: Callable[[str], None]
) -> "Inertial | None":
    """The IMU's part in a run over the chosen scans; None where the odometry uses no IMU.

    Its rotation is found where none is known; the errors of clock and rotation that the first scans show are corrected,
    and told with `warn`. InputError where samples are damaged or contradict the scans, or the rotation is neither known
    nor observable.
    """
    samples = imu_samples(config, recording)
    if samples is None:
        return None
    from lidarslam.mapping.inertial.comparison import no_gravity
    from lidarslam.mapping.inertial.inertial import KNOWN_LEVER_M, UNKNOWN_LEVER_M, Inertial

    for note in samples.notes:
        warn(note)
    if (wrong := no_gravity(samples) or _other_clock(samples, recording)) is not None:
        raise InputError(f"{recording.name}: {wrong}; correct the IMU's data, or {_INSTEAD}")
    T_lidar_imu = samples.T_lidar_imu
    if (T_recorded_imu := config.odometry.T_recorded_imu) is not None:
        T_lidar_imu = recorded_axes(recording)[1] @ T_recorded_imu
    poses, lever_sigma_m = _Poses(config, recording, chosen), KNOWN_LEVER_M
    if T_lidar_imu is None:
        logger.info("finding how the IMU is mounted")
        T_lidar_imu, lever_sigma_m = _found(poses, recording.name, samples), UNKNOWN_LEVER_M
    logger.info("comparing the IMU with the first scans")
    return Inertial(*_aligned(poses, recording.name, samples, T_lidar_imu, warn), lever_sigma_m)


def found_imu(inertial: "Inertial", recording: Recording) -> str | None:
    """A message with the settings for an extrinsic calibration that was estimated; None where it was given."""
    if inertial.is_mounting_known:
        return None
    from scipy.spatial.transform import Rotation  # takes a while to load

    T = inverse(recorded_axes(recording)[1]) @ inertial.T_lidar_imu
    angles_deg, position_m = Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True), T[:3, 3]
    values = {"odometry.imu_rotation_deg": angles_deg, "odometry.imu_position_m": position_m}
    settings = [f"{key}=[{','.join(f'{one:.2f}' for one in value)}]" for key, value in values.items()]
    words = command_line(*(word for setting in settings for word in ("--set", setting)))
    return f"the IMU's extrinsic calibration was estimated; give it to other runs by {words}"


def _other_clock(samples: ImuSamples, recording: Recording) -> str | None:
    """Why the stamps of the samples do not match those of the scans; None where they do."""
    info, (first, last) = recording.describe(), samples.stamps[[0, -1]]
    if (rate_hz := samples.rate_hz) is not None and rate_hz < _LEAST_RATE_HZ:
        return f"the IMU has a sample every {1.0 / rate_hz:.3g} s, too few for a sweep: check the unit of its stamps"
    if first <= info.last_stamp and last >= info.first_stamp:
        return None
    scans = f"{info.first_stamp:.3f} to {info.last_stamp:.3f} s"
    return f"the IMU's samples are from {first:.3f} to {last:.3f} s, on another clock than the scans, from {scans}"


def make_imu_stream(config: Config, warn: Callable[[str], None]) -> "ImuStream | None":
    """The IMU's part where samples arrive one by one, which warns of faults; None where the odometry uses none."""
    if not config.odometry.uses_imu:
        return None
    from lidarslam.pipeline.imu_stream import ImuStream

    T_recorded_imu = config.odometry.T_recorded_imu
    return ImuStream(None if T_recorded_imu is None else transform_of(config.reader.mounting) @ T_recorded_imu, warn)


def _registered(config: Config, recording: Recording, chosen: range) -> Iterator[tuple[SampledScan, MappedScan]]:
    """The first scans, registered to each other without an odometry; up to one that cannot be read."""
    mapper = Mapper(config.mapping.model_copy(update={"budget_ms": None}))
    with suppress(InputError):  # raised again when the scans are read
        for scan in take_in(recording, chosen, Faults()):
            sampled = mapper.sample(scan)
            yield sampled, mapper.process(sampled, Prior())


class _Poses:
    """Poses of the first scans without the IMU, in their order; registered as they are asked for."""

    def __init__(self, config: Config, recording: Recording, chosen: range) -> None:
        self._scans = _registered(config, recording, chosen)
        self._poses: list[tuple[float, FloatArray, bool]] = []

    def __iter__(self) -> Iterator[tuple[float, FloatArray, bool]]:
        yield from self._poses
        for scan, mapped in self._scans:
            self._poses.append((scan.stamp, mapped.state.T_world_lidar, mapped.registered and mapped.is_connected))
            yield self._poses[-1]

    def compared(self, samples: ImuSamples, T_lidar_imu: FloatArray, most: int) -> "Iterator[Comparison]":
        """The comparison with an IMU after every ten of at most `most` scans, and after the last."""
        from lidarslam.mapping.inertial.comparison import Comparison

        comparison = Comparison(samples, T_lidar_imu)
        for number, pose in enumerate(islice(self, most), start=1):
            comparison.add(*pose)
            if number % _EVERY == 0:
                yield comparison
        yield comparison


def _found(poses: _Poses, name: str, samples: ImuSamples) -> FloatArray:
    """(4, 4) T_lidar_imu by the turns of the scans, its position unknown; InputError where they do not show it."""
    from lidarslam.mapping.inertial.comparison import MountingError

    reason = "too few scans"
    for comparison in poses.compared(samples, np.eye(4), _MOST_SCANS):
        try:
            mounting = comparison.mounting()
        except MountingError as error:
            reason = str(error)
        else:
            logger.info("the IMU's mounting was found to %.2f degrees", np.rad2deg(mounting.sigma))
            return make_transform(mounting.R_lidar_imu, np.zeros(3))
    raise InputError(
        f"{name}: the extrinsic rotation of its IMU is not recorded, and not observable ({reason}); give its roll,"
        f" pitch and yaw with {_ROTATION}, or {_INSTEAD}"
    )


def _aligned(
    poses: _Poses, name: str, samples: ImuSamples, T_lidar_imu: FloatArray, warn: Callable[[str], None]
) -> tuple[ImuSamples, FloatArray]:
    """Samples on the LiDAR's clock, and T_lidar_imu (4, 4), without the errors that the first scans show.

    InputError where they show that the samples, or their axes, are something else.
    """
    from lidarslam.mapping.inertial.comparison import FEWEST_COMPARED, MOST_CORRECTIONS

    said: list[str] = []
    for _ in range(MOST_CORRECTIONS):
        for comparison in poses.compared(samples, T_lidar_imu, _COMPARED_SCANS):
            found = comparison.alignment()
            if len(comparison) >= FEWEST_COMPARED and found.is_certain:
                break
        contradiction = comparison.contradiction()
        if contradiction is not None:
            raise InputError(f"{name}: {contradiction}; correct the IMU's data, give {_ROTATION}, or {_INSTEAD}")
        if not (sentences := found.sentences()):
            break
        said = said or sentences
        samples = replace(samples, stamps=samples.stamps - found.significant_offset_s)
        T_lidar_imu = found.corrected(T_lidar_imu)
    for sentence in said:
        warn(sentence)
    return samples, T_lidar_imu


# An error is certain beyond this many standard deviations.
_CERTAIN_SIGMAS = 4.0
# The elevations of a sensor whose recorded z axis is farther from up or down than this are about another axis.
_UPRIGHT = 0.999
# Scans that are registered beforehand, at most; fewer where the error is known well enough before.
_MOST_ELEVATION_SCANS, _ENOUGH_STRETCHES = 300, 3


@dataclass(frozen=True)
class Elevation:
    """The degrees by which the points of a recording have to be raised, and were."""

    elevation_bias_deg: float
    elevation_sigma_deg: float  # standard deviation of the bias
    elevation_correction_deg: float  # by which they were raised

    @classmethod
    def found(cls, recording: Recording, estimator: ElevationEstimator) -> "Elevation | None":
        """The result of an estimator on a recording's scans."""
        raised_deg, upwards = elevation_of(recording)
        bias = estimator.bias() if abs(upwards) > _UPRIGHT else None
        if bias is None:
            return None
        angle_deg = float(np.rad2deg(np.sign(upwards) * bias.angle))
        return cls(raised_deg + angle_deg, float(np.rad2deg(bias.sigma)), raised_deg)

    @property
    def warning(self) -> str | None:
        """The remedy, where the correction is certainly wrong."""
        wrong_deg = self.elevation_bias_deg - self.elevation_correction_deg
        if abs(wrong_deg) <= _CERTAIN_SIGMAS * self.elevation_sigma_deg:
            return None
        return (
            f"elevation bias of {self.elevation_bias_deg:+.2f} +- {self.elevation_sigma_deg:.2f} degrees, where"
            f" {self.elevation_correction_deg:g} are corrected: try --set"
            f" reader.elevation_correction_deg={self.elevation_bias_deg:.2f}"
        )


def with_elevations(
    request: RunRequest, recording: Recording, chosen: range, phase: Callable[[str], None]
) -> tuple[RunRequest, Recording]:
    """The request and its recording, with a number for `reader.elevation_correction_deg: auto`.

    It is estimated from the first scans, registered to each other without an odometry, where it is certain; else it is
    the angle by which they are raised already. A resumed run finds the same.
    """
    if request.config.reader.elevation_correction_deg != "auto":
        return request, recording
    phase("estimating the error of the elevations")
    estimator = ElevationEstimator()
    scans = range(chosen.start, chosen.stop)[:_MOST_ELEVATION_SCANS]
    for sampled, mapped in _registered(request.config, recording, scans):
        estimator.add(sampled, mapped)
        if estimator.stretches == _ENOUGH_STRETCHES:
            break
    found = Elevation.found(recording, estimator)
    angle_deg, _ = elevation_of(recording)
    if found is not None and found.warning is not None:
        angle_deg = round(found.elevation_bias_deg, 3)
    config = request.config.having("reader", elevation_correction_deg=angle_deg)
    return replace(request, config=config), open_recording(request.source, config.reader)


# Slower turns, rad/s, and fewer scans decide nothing; between scans farther apart, a shaken sensor turns differently.
_LEAST_RATE, _FEWEST, _MOST_INTERVAL_S = np.deg2rad(5.0), 15, 0.15
# A share of the intervals by which they may differ.
_EVEN = 0.5
# Ratios with the right times: 0.99 to 1.19 on simulated and real recordings; with doubled ones 0.5 to 0.7.
_RIGHT = (0.75, 1.4)


def time_scale(
    trajectory: Trajectory, turn_rates: FloatArray, is_tracked: NDArray[np.bool_]
) -> tuple[float, int] | None:
    """Ratio of the turn rates within sweeps to those from scan to scan; one where the points' times are right.

    Of N scans, the turn rates (N, 3) rad/s within each sweep, in the LiDAR frame and NaN where unknown, and whether the
    pose is right (N,). With the number of scans that turned; None where too few did.
    """
    T, interval_s = trajectory.T_world_lidar, np.diff(trajectory.stamps)
    if len(T) < _FEWEST or np.median(interval_s) > _MOST_INTERVAL_S:
        return None
    rates = log(inverse(T[:-1]) @ T[1:])[:, :3] / interval_s[:, None]
    is_even = np.abs(interval_s / np.median(interval_s) - 1.0) < _EVEN
    is_even &= is_tracked[:-1] & is_tracked[1:]
    # A sweep may lie before or after its stamp.
    around, within = 0.5 * (rates[:-1] + rates[1:]), turn_rates[1:-1]
    turns = is_even[:-1] & is_even[1:] & np.isfinite(within).all(axis=1)
    turns &= np.linalg.norm(around, axis=1) > _LEAST_RATE
    if turns.sum() < _FEWEST:
        return None
    return float((within * around)[turns].sum() / (around[turns] ** 2).sum()), int(turns.sum())


def time_scale_warning(found: tuple[float, int] | None) -> str | None:
    """The error of the points' times by a ratio; None where it is near one, or unknown."""
    if found is None or _RIGHT[0] < found[0] < _RIGHT[1]:
        return None
    ratio, scans = found
    fault = "backwards" if ratio < 0.0 else "too long" if ratio < 1.0 else "too short"
    return (
        f"the points' times are {fault}, as it seems: within the sweeps of {scans} scans the sensor turns {ratio:.2f}"
        " times as fast as from scan to scan; check reader.time_unit and reader.time_field, or correct them with"
        f" --set reader.time_scale={'-1' if ratio < 0.0 else 'FACTOR'}"
    )


# The shortest motions that are compared, metres, and their least number. Two motions disagree where they differ by more
# than both bounds, in metres and as a share of the motion; the share of disagreeing ones of a wrong prior.
_LEAST_MOTION_M, _FEWEST_MOTIONS = 0.02, 10
_DISAGREEING_M, _DISAGREEING_SHARE, _MOSTLY = 0.05, 0.5, 0.5


def prior_warning(prior: Trajectory, registered: Trajectory) -> str | None:
    """A warning where most motions of a prior disagree with the registered ones at the same stamps; else None."""
    given, found = prior.relative_motions(), registered.relative_motions()
    moved_m = np.linalg.norm(found[:, :3, 3], axis=1)
    off_m = np.linalg.norm((inverse(given) @ found)[:, :3, 3], axis=1)
    disagree = (off_m > np.maximum(_DISAGREEING_M, _DISAGREEING_SHARE * moved_m))[moved_m > _LEAST_MOTION_M]
    if len(disagree) < _FEWEST_MOTIONS or disagree.mean() < _MOSTLY:
        return None
    return (
        f"the motions of the prior are not those of the scans on {disagree.sum():,} of {len(disagree):,} moving scans;"
        " its poses have to be those of the LiDAR (T_odom_lidar), in its axes and of this recording"
    )
