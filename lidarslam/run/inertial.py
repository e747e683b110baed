"""The IMU of a recording, ready for a run: its samples, and how it is mounted."""

import logging
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import FloatArray, exp, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.mounting.recording import recorded_axes
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.surfel_mapper import SurfelMapper

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.inertial.comparison import Comparison
    from lidarslam.mapping.inertial.inertial import Inertial

logger = logging.getLogger(__name__)

_INSTEAD = "choose --odometry learned, which needs none"
_ROTATION = "--set odometry.imu_rotation_deg=[R,P,Y]"
# Scans that a rotation is looked for in at most, and after how many.
_MOST_SCANS, _EVERY = 600, 10
# Scans that clock and rotation are compared in at most, turns at least, and how often. Until the clock is this certain.
_COMPARED_SCANS, _COMPARED_TURNS, _ALIGNED_TIMES, _CLOCK_SIGMA_S = 60, 30, 3, 0.001
# Errors are corrected from here on, and by so many deviations.
_LEAST_OFFSET_S, _LEAST_ROTATION, _DEVIATIONS = 0.003, np.deg2rad(1.0), 4.0


def imu_samples(config: Config, recording: Recording) -> ImuSamples | None:
    """The samples that the odometry needs; None where it uses no IMU.

    Raises:
        ConfigError: the recording has no IMU.
        InputError: the samples are damaged.
    """
    if not config.odometry.uses_imu:
        return None
    samples = recording.imu
    if samples is None or len(samples) < 2:
        raise ConfigError(f"{recording.name}: has no IMU, for --odometry {config.odometry.method}; {_INSTEAD}")
    return samples


def open_inertial(
    config: Config, recording: Recording, chosen: range, warn: Callable[[str], None]
) -> "Inertial | None":
    """The IMU's part in a run over the chosen scans; None where the odometry uses no IMU.

    Its rotation is found where none is known; the errors of clock and rotation that the first scans show are corrected.

    Args:
        config: the configuration.
        recording: has an IMU.
        chosen: numbers of the scans.
        warn: called with each error that was corrected.

    Raises:
        ConfigError: the recording has no IMU.
        InputError: its samples are damaged or contradict the scans, or its rotation is neither known nor observable.
    """
    samples = imu_samples(config, recording)
    if samples is None:
        return None
    from lidarslam.mapping.inertial.inertial import Inertial

    for note in samples.notes:
        warn(note)
    T_lidar_imu = samples.T_lidar_imu
    if config.odometry.imu_rotation_deg is not None:
        T_recorded_imu = make_transform(_rotation(config.odometry.imu_rotation_deg), np.zeros(3))
        T_lidar_imu = recorded_axes(recording)[1] @ T_recorded_imu
    poses = _Poses(config, recording, chosen)
    if T_lidar_imu is None:
        logger.info("finding how the IMU is mounted")
        T_lidar_imu = _found(poses, recording.name, samples)
    logger.info("comparing the IMU with the first scans")
    return Inertial(*_aligned(poses, recording.name, samples, T_lidar_imu, warn))


def _rotation(roll_pitch_yaw_deg: tuple[float, float, float]) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("xyz", roll_pitch_yaw_deg, degrees=True).as_matrix(), dtype=np.float64)


class _Poses:
    """Registered poses of the first scans without the IMU, in their order; registered as they are asked for."""

    def __init__(self, config: Config, recording: Recording, chosen: range) -> None:
        self._scans = take_in(recording, chosen, Faults())
        self._mapper = SurfelMapper(config.mapping)
        self._poses: list[tuple[float, FloatArray, bool]] = []

    def compared(self, samples: ImuSamples, T_lidar_imu: FloatArray, most: int) -> "Iterator[Comparison]":
        """The comparison with an IMU after every ten scans, until there are no more, or so many."""
        from lidarslam.mapping.inertial.comparison import Comparison

        comparison = Comparison(samples, T_lidar_imu)
        for number in range(most):
            if number == len(self._poses) and not self._register():
                break
            comparison.add(*self._poses[number])
            if (number + 1) % _EVERY == 0:
                yield comparison
        yield comparison

    def _register(self) -> bool:
        """Register the next scan; whether there is one."""
        scan = None
        with suppress(InputError):  # raised again when the scans are read
            scan = next(self._scans, None)
        if scan is not None:
            mapped = self._mapper.process(scan, Prior())
            follows = mapped.registered and mapped.is_connected
            self._poses.append((scan.stamp, mapped.state.T_world_lidar, follows))
        return scan is not None


def _found(poses: _Poses, name: str, samples: ImuSamples) -> FloatArray:
    """(4, 4) T_lidar_imu from the turns of the first scans; its position stays unknown.

    Raises:
        InputError: they do not show it.
    """
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

    Raises:
        InputError: they show that the samples, or their axes, are something else.
    """
    offset_s, rotation = 0.0, np.zeros(3)
    for _ in range(_ALIGNED_TIMES):
        for comparison in poses.compared(samples, T_lidar_imu, _COMPARED_SCANS):
            found = comparison.alignment()
            if len(comparison) >= _COMPARED_TURNS and found.offset_sigma_s < _CLOCK_SIGMA_S:
                break
        contradiction = comparison.contradiction()
        if contradiction is not None:
            raise InputError(f"{name}: {contradiction}; correct the IMU's data, give {_ROTATION}, or {_INSTEAD}")
        is_late = abs(found.offset_s) > max(_LEAST_OFFSET_S, _DEVIATIONS * found.offset_sigma_s)
        is_turned = np.linalg.norm(found.rotation) > max(_LEAST_ROTATION, _DEVIATIONS * found.rotation_sigma)
        if is_late:
            offset_s += found.offset_s
            samples = replace(samples, stamps=samples.stamps - found.offset_s)
        if is_turned:
            turn = exp(np.pad(found.rotation, (0, 3)))[:3, :3]
            T_lidar_imu = make_transform(turn @ T_lidar_imu[:3, :3], T_lidar_imu[:3, 3])
            rotation = rotation + found.rotation
        if not (is_late or is_turned):
            break
    if offset_s:
        late = "late" if offset_s > 0.0 else "early"
        warn(f"the IMU's stamps are {1e3 * abs(offset_s):.0f} ms {late}; corrected")
    if rotation.any():
        degrees = np.rad2deg(np.linalg.norm(rotation))
        warn(f"the IMU is turned by {degrees:.1f} degrees against its extrinsic calibration; corrected")
    return samples, T_lidar_imu
