"""The GNSS track of a recording: KITTI's GPS/IMU unit, or sensor_msgs/NavSatFix in a bag."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.mounted_recording import recorded_axes
from lidarslam.datasets.published.kitti_raw import KittiRawRecording
from lidarslam.datasets.registry import open_recording
from lidarslam.datasets.ros.bag_file import BagFile
from lidarslam.datasets.ros.bag_imu import static_transform
from lidarslam.datasets.ros.bag_message import deserialize
from lidarslam.datasets.ros.rosbag import BagRecording
from lidarslam.mapping.global_map.products.georeference import GnssTrack

_FIX_TYPE = "sensor_msgs/msg/NavSatFix"
_NO_FIX = -1
_SAME_PLACE = "where the antenna is on the sensor is unknown, so it is taken to be at the LiDAR"


def read_gnss(source: Path, config: ReaderConfig) -> GnssTrack:
    """Read the GNSS track of a recording.

    Raises:
        InputError: the recording cannot be read, or has none.
    """
    recording, T_upright_recorded = recorded_axes(open_recording(source, config))
    track = None
    if isinstance(recording, KittiRawRecording):
        track = _of_drive(recording)
    elif isinstance(recording, BagRecording):
        track = _of_bag(*recording.frames)
    if track is None:
        readable = "KITTI raw drives with oxts, and bags with sensor_msgs/NavSatFix"
        raise InputError(f"{source}: has no GNSS positions; it is read from {readable}")
    return replace(track, lidar_antenna=T_upright_recorded[:3, :3] @ track.lidar_antenna)


def _of_drive(drive: KittiRawRecording) -> GnssTrack | None:
    if drive.oxts is None:
        return None
    rows, stamps = drive.oxts
    T_lidar_imu = None if drive.imu is None else drive.imu.T_lidar_imu
    timed = np.isfinite(stamps)
    place = np.zeros(3) if T_lidar_imu is None else T_lidar_imu[:3, 3]
    notes = (_SAME_PLACE,) if T_lidar_imu is None else ()
    return GnssTrack(stamps[timed], rows.geodetic[timed], rows.accuracy_m[timed], place, notes)


def _of_bag(bag: BagFile, lidar_frame: str) -> GnssTrack | None:
    """Of the topic with the most fixes; those that state no fix are left out."""
    topics = [topic for topic in bag.topics if topic.message_type == _FIX_TYPE]
    if not topics:
        return None
    stamps, geodetic, sigmas, frame_id = [], [], [], ""
    for message in bag.messages(max(topics, key=lambda topic: topic.messages)):
        if message.damage is not None:
            continue
        with suppress(Exception):  # damaged bytes make rosbags raise nearly anything; the others stand
            fix = deserialize(message.raw, _FIX_TYPE, bag.ros2)
            if fix.status.status == _NO_FIX or not np.isfinite([fix.latitude, fix.longitude, fix.altitude]).all():
                continue
            horizontal = fix.position_covariance.reshape(3, 3)[:2, :2]
            variance = 0.5 * horizontal.trace() if fix.position_covariance_type else np.nan
            stamps.append((message.header_ns or message.record_ns) / 10**9)
            geodetic.append([fix.latitude, fix.longitude, fix.altitude])
            sigmas.append(float(np.sqrt(variance)))
            frame_id = message.frame_id
    if not stamps:
        return None
    T_lidar_antenna = static_transform(bag, lidar_frame, frame_id)
    place = np.zeros(3) if T_lidar_antenna is None else T_lidar_antenna[:3, 3]
    order = np.argsort(stamps, kind="stable")
    notes = (_SAME_PLACE,) if T_lidar_antenna is None else ()
    return GnssTrack(np.array(stamps)[order], np.array(geodetic)[order], np.array(sigmas)[order], place, notes)
