"""The IMU of a recording, ready for a run: its samples, and how it is mounted."""

import logging
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.errors import ConfigError, InputError
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import take_in
from lidarslam.datasets.mounting.recording import recorded_axes
from lidarslam.datasets.recording import Recording
from lidarslam.mapping.inertial.mounting import Mounting, MountingError, Turns, find_mounting
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.surfel_mapper import SurfelMapper

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.inertial.inertial import Inertial

logger = logging.getLogger(__name__)

_INSTEAD = "choose --odometry learned, which needs none"
# Scans whose turns are compared with the gyroscope's at most, and after how many they are looked at.
_MOST_SCANS, _EVERY = 600, 50


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


def open_inertial(config: Config, recording: Recording, chosen: range) -> "Inertial | None":
    """The IMU's part in a run over the chosen scans; None where the odometry uses no IMU.

    Raises:
        ConfigError: the recording has no IMU.
        InputError: its samples are damaged, or its extrinsic rotation is neither known nor observable.
    """
    samples = imu_samples(config, recording)
    if samples is None:
        return None
    from lidarslam.mapping.inertial.inertial import Inertial

    T_lidar_imu = samples.T_lidar_imu
    if config.odometry.imu_rotation_deg is not None:
        T_recorded_imu = make_transform(_rotation(config.odometry.imu_rotation_deg), np.zeros(3))
        T_lidar_imu = recorded_axes(recording)[1] @ T_recorded_imu
    if T_lidar_imu is None:
        logger.info("finding how the IMU is mounted")
        T_lidar_imu = _found(config, recording, chosen, samples)
    return Inertial(samples, T_lidar_imu)


def _rotation(roll_pitch_yaw_deg: tuple[float, float, float]) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("xyz", roll_pitch_yaw_deg, degrees=True).as_matrix(), dtype=np.float64)


def _found(config: Config, recording: Recording, chosen: range, samples: ImuSamples) -> FloatArray:
    """(4, 4) T_lidar_imu from the turns of the first scans, registered without the IMU; its position stays unknown.

    Raises:
        InputError: they do not show it.
    """
    mapper, turns = SurfelMapper(config.mapping), Turns(samples)
    mounting: Mounting | None = None
    reason = "too few scans"
    for number, scan in enumerate(islice(take_in(recording, chosen, Faults()), _MOST_SCANS), 1):
        mapped = mapper.process(scan, Prior())
        turns.add(scan.stamp, mapped.state.T_world_lidar[:3, :3], mapped.registered and mapped.is_connected)
        if number % _EVERY == 0:
            try:
                mounting = find_mounting(turns)
                break
            except MountingError as error:
                reason = str(error)
    if mounting is None:
        raise InputError(
            f"{recording.name}: the extrinsic rotation of its IMU is not recorded, and not observable ({reason}); give"
            f" its roll, pitch and yaw with --set odometry.imu_rotation_deg=[R,P,Y], or {_INSTEAD}"
        )
    logger.info("the IMU's mounting was found to %.2f degrees", np.rad2deg(mounting.sigma))
    return make_transform(mounting.R_lidar_imu, np.zeros(3))
