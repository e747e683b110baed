"""Mountings by their names or angles, as rotations, and scans corrected by them."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import Mounting, MountingName, RollPitchYaw

# Roll, pitch, yaw in degrees of the recorded axes: which way the recorded z axis points, seen by who looks along x.
_ANGLES_DEG: dict[MountingName, RollPitchYaw] = {
    "upright": (0.0, 0.0, 0.0),
    "upside-down": (180.0, 0.0, 0.0),
    "left": (-90.0, 0.0, 0.0),
    "right": (90.0, 0.0, 0.0),
    "forward": (0.0, 90.0, 0.0),
    "backward": (0.0, -90.0, 0.0),
    "camera": (-90.0, 0.0, -90.0),
}
_SNAPPED = np.cos(np.deg2rad(20.0))
# The calibration of the laser that KITTI was recorded with places every point too low; without the correction the
# average error of KISS-ICP on KITTI doubles. Upwards; the value of KISS-ICP and CT-ICP.
KITTI_DEG = 0.205
# Keeps the division finite for the origin, a driver's mark for "no return", which has to stay the origin.
_SMALLEST_RHO_M = 1e-30


def transform_of(mounting: Mounting) -> FloatArray:
    """T_upright_recorded (4, 4), a rotation; exact of quarter turns, and the identity where it is `auto`."""
    if mounting == "auto" or mounting == "upright":  # noqa: PLR1714 - mypy narrows by it
        return np.eye(4)
    from scipy.spatial.transform import Rotation  # takes a while to load

    angles = _ANGLES_DEG[mounting] if isinstance(mounting, str) else mounting
    R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    whole = np.round(R)
    return make_transform(whole if np.abs(R - whole).max() < 1e-12 else R, np.zeros(3))


def corrected(scan: Scan, T_upright_recorded: FloatArray, raised_deg: float, time_scale: float) -> Scan:
    """A scan of the recorded axes in upright ones.

    Args:
        scan: as recorded.
        T_upright_recorded: (4, 4), a rotation.
        raised_deg: added to the elevations of all points, above the recorded x-y plane.
        time_scale: factor on the points' times from the stamp.
    """
    scan = scan.with_times_scaled(time_scale)
    if raised_deg:
        scan = replace(scan, points=correct_elevation(scan.points, raised_deg))
    if np.array_equal(T_upright_recorded, np.eye(4)):
        return scan
    return replace(scan, points=np.ascontiguousarray(scan.points @ T_upright_recorded[:3, :3].T))


def mounting_with_up(up: FloatArray) -> Mounting:
    """The mounting whose upwards direction, a unit vector (3,) in the recorded axes, is this or nearly so.

    It has a name where one is near; the yaw stays open and is small.
    """
    named = {name: transform_of(name)[2, :3] for name in _ANGLES_DEG if name != "camera"}
    for name, direction in named.items():
        if direction @ up > _SNAPPED:
            return name
    roll = float(np.arctan2(up[1], up[2]))
    pitch = float(np.arctan2(-up[0], np.hypot(up[1], up[2])))
    return (float(np.round(np.rad2deg(roll))), float(np.round(np.rad2deg(pitch))), 0.0)


def written(mounting: Mounting) -> str:
    """As the value of `--set reader.mounting=`."""
    return mounting if isinstance(mounting, str) else "[" + ",".join(f"{angle:g}" for angle in mounting) + "]"


def correct_elevation(points: NDArray[np.floating], angle_deg: float) -> FloatArray:
    """Raise the elevation of every point, seen from the sensor, by the same angle.

    Each point p turns about the axis p x z_hat, which leaves its range and azimuth as they were. With rho the
    horizontal range the turn happens in the (rho, z) plane: rho' = rho cos a - z sin a, z' = rho sin a + z cos a,
    and x and y scale by rho' / rho. The rule, with 0.205 degrees for KITTI, is that of KISS-ICP (Vizzo et al.,
    RA-L 2023) and of CT-ICP and IMLS-SLAM before it.

    Args:
        points: (N, 3), LiDAR frame; may hold invalid points, which stay invalid.
        angle_deg: upwards positive.

    Returns:
        (N, 3) float64, a new array.
    """
    corrected, angle = np.empty((len(points), 3)), math.radians(angle_deg)
    _raise(points, math.sin(angle), math.cos(angle), corrected)
    return corrected


@compiled
def _raise(points: NDArray[np.floating], sine: float, cosine: float, corrected: FloatArray) -> None:
    """Write points (N, 3), raised by an angle."""
    for n in range(len(points)):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        rho = np.sqrt(x * x + y * y)
        scale = cosine - sine * (z / (rho if rho > _SMALLEST_RHO_M else _SMALLEST_RHO_M))
        corrected[n, 0], corrected[n, 1], corrected[n, 2] = x * scale, y * scale, rho * sine + z * cosine
