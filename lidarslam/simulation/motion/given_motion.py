"""Following a trajectory that is given, such as KITTI's ground truth."""

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.motion.carriers import find_carrier
from lidarslam.simulation.motion.ground_contact import ground_under
from lidarslam.simulation.motion.motions import Motion, Sway
from lidarslam.simulation.world import World

_STEEPEST_DEG = 80.0
_FEWEST_TO_SMOOTH = 5


def motion_along(
    trajectory: Trajectory, world: World | None, on_ground: bool = True, carrier: str = "car", smoothing_s: float = 0.0
) -> Motion:
    """Follow a trajectory in its own time, on smooth splines; after the last pose the body stays where it is.

    The trajectory's world frame is the world's; the world has to be made around it (`worlds.street.along`), or the
    path be checked (`path_clearance`).

    Args:
        trajectory: poses of a frame with x forwards and z up.
        world: gives the ground, if the motion is on it.
        on_ground: take position and heading from the trajectory, height, roll and pitch from the ground under the
            carrier; else take the poses as they are, for what flies or is carried.
        carrier: whose footprint and sensor height are meant when on the ground.
        smoothing_s: time within which the trajectory's noise is evened out: centimetres of a GPS receiver at 10 Hz
            are accelerations that no car survives, which 0.25 s removes. 0 goes through every pose.

    Raises:
        InputError: the trajectory has fewer than two poses, points straight up or down, or on the ground moves along
            its own z axis, as cameras' trajectories do.
    """
    if len(trajectory) < 2:
        raise InputError(f"a motion needs two poses or more, the trajectory has {len(trajectory)}")
    angles = Rotation.from_matrix(trajectory.T_world_lidar[:, :3, :3]).as_euler("ZYX")
    if np.abs(angles[:, 1]).max() > np.deg2rad(_STEEPEST_DEG):
        raise InputError(f"a motion cannot look up or down by more than {_STEEPEST_DEG:g} degrees; the trajectory does")
    steps = np.abs(trajectory.relative_motions()[:, :3, 3]).sum(axis=0)
    if on_ground and steps[2] > steps[0]:
        raise InputError("the trajectory moves along its z axis, not along x; is it in the frame of a camera?")
    times = trajectory.stamps - trajectory.stamps[0]
    xyz = _smoothed(times, trajectory.positions, smoothing_s)
    yaw, pitch, roll = _smoothed(times, np.unwrap(angles, axis=0), smoothing_s).T
    height = 0.0
    if on_ground and world is not None:
        body = find_carrier(carrier)
        height = body.sensor_height_m
        ground = ground_under(world, xyz[:, :2], body.footprint_m)
        pitch, roll = ground.pitch_and_roll(yaw)
        xyz = np.column_stack([xyz[:, :2], ground.height])
    base = np.column_stack([xyz, roll, pitch, yaw, np.zeros(len(xyz))])
    return Motion("given", times, base, Sway(), height, repeats=False)


def _smoothed(times: FloatArray, values: FloatArray, smoothing_s: float) -> FloatArray:
    """Values (N, D) of the smoothing spline that follows what lasts longer."""
    if smoothing_s <= 0.0 or len(times) < _FEWEST_TO_SMOOTH:
        return values
    # Of the smoothing spline's balance, lam * integral(f''^2), the response to a frequency w is 1 / (1 + lam dt w^4).
    balance = smoothing_s**4 / float(np.median(np.diff(times)))
    return np.column_stack([make_smoothing_spline(times, column, lam=balance)(times) for column in values.T])
