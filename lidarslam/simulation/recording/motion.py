"""The motion of a recording's sensor: a carrier on the world's route, or along a trajectory from a file."""

from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse, make_transform
from lidarslam.core.pose_text import read_kitti_poses
from lidarslam.core.text.trajectory_io import read_tum
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.motion.carriers import Carrier, find_carrier
from lidarslam.simulation.motion.given_motion import motion_along
from lidarslam.simulation.motion.motions import Motion
from lidarslam.simulation.motion.route_motion import motion_along_route
from lidarslam.simulation.recording.request import RecordRequest
from lidarslam.simulation.sensors.sensor import Sensor
from lidarslam.simulation.world import World

_SCANS = 300
_KITTI_RATE_HZ = 10.0
# KITTI's poses jump by centimetres, as the GPS behind them did: at 10 Hz more than a car's acceleration.
_KITTI_SMOOTHING_S = 0.25
_KITTI_COLUMNS = 12
_PATH_STEP_S = 0.05
# KITTI's pose files are in the frame of a camera: x to the right, y down, z forward.
_T_CAM_BODY = make_transform([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], np.zeros(3))


def plan_motion(request: RecordRequest, world: World, sensor: Sensor) -> tuple[Motion, int]:
    """The motion and the number of scans: as many as asked for, else 300 or as long as the trajectory lasts.

    Carriers that lean with the ground follow a trajectory on the ground, the others take its poses as they are.

    Raises:
        InputError: there is no such carrier, it cannot go along the route, or the trajectory cannot be followed, is too
            short, or comes with a speed.
    """
    if request.trajectory is None:
        motion = motion_along_route(request.motion, world, request.seed, request.speed_mps)
        return motion, request.scans or _SCANS
    if request.speed_mps is not None:
        raise InputError(f"{request.trajectory}: a trajectory has its own speed; leave out --speed")
    trajectory = read_trajectory(request.trajectory)
    motion = _along(request.trajectory, trajectory, world, find_carrier(request.motion))
    most = int(trajectory.duration_s * sensor.rate_hz + 1e-6)  # the last sweep has to end before the trajectory does
    if not 1 <= (request.scans or most) <= most:
        raise InputError(
            f"{request.trajectory}: lasts {trajectory.duration_s:.1f} s, enough for {most} scans of a {sensor.name},"
            f" got --scans {request.scans or 1}"
        )
    return motion, request.scans or most


def _along(path: Path, trajectory: Trajectory, world: World | None, carrier: Carrier) -> Motion:
    on_ground = carrier.leans_with_ground and world is not None
    return motion_along(trajectory, world, on_ground, carrier.name, _KITTI_SMOOTHING_S if _is_kitti(path) else 0.0)


def given_path(path: Path, motion: str) -> FloatArray:
    """Way of a carrier along a trajectory: (N, 2), or for carriers that do not follow the ground (N, 3).

    The third column is the height of the ground that fits the trajectory: as far below it as the carrier holds or
    flies the sensor. Raises InputError as `plan_motion` does.
    """
    trajectory, carrier = read_trajectory(path), find_carrier(motion)
    given = _along(path, trajectory, None, carrier)
    steps = max(1, int(np.ceil(given.duration_s / _PATH_STEP_S)))
    positions = given.pose_at(np.linspace(0.0, given.duration_s, steps + 1))[:, :3, 3]
    if carrier.leans_with_ground:
        return np.asarray(positions[:, :2])
    return positions - [0.0, 0.0, carrier.sensor_height_m + carrier.flight_height_m]


def read_trajectory(path: Path) -> Trajectory:
    """A TUM file, or a KITTI pose file with the poses of a camera at 10 Hz; x forwards, z up.

    Raises:
        InputError: it is neither.
    """
    if not _is_kitti(path):
        return read_tum(path)
    T_cam0_cam = read_kitti_poses(path)
    stamps = np.arange(len(T_cam0_cam)) / _KITTI_RATE_HZ
    return Trajectory(stamps, inverse(_T_CAM_BODY) @ T_cam0_cam @ _T_CAM_BODY)


def _is_kitti(path: Path) -> bool:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from error
    words = (line.split("#", 1)[0].replace(",", " ").split() for line in lines)
    return next((len(found) for found in words if found), 0) == _KITTI_COLUMNS
