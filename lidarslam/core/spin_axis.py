"""The axis that a LiDAR spins about, by the directions of its points.

Rows of a range image are cones about its z axis. Points that were recorded in other axes, as of a camera or a vehicle
on its side, lie across the rows and over the poles.
"""

import numpy as np

from lidarslam.core.geometry import FloatArray, levelling

# Points spread over less than this about z lie in rows, and about another axis the spread must be less by as much.
_WIDE, _NARROWER = np.deg2rad(60.0), np.deg2rad(30.0)
# Share of the directions that is left out on either side, as strays.
_STRAY_SHARE = 0.005
# An axis of the recording is preferred to one that is narrower by less than this.
_SAME = np.deg2rad(2.0)
_FEWEST, _AXES, _DIRECTIONS, _FINE_DIRECTIONS = 200, 600, 1500, 12_000
_FIRST_STEP, _LAST_STEP = np.deg2rad(4.0), np.deg2rad(0.05)


def image_axes(points: FloatArray) -> FloatArray:
    """R_image_lidar (3, 3): the smallest rotation that takes the spin axis of points (N, 3) to z.

    It is the identity unless the points show clearly that they were not taken about z.
    """
    ranges = np.linalg.norm(points, axis=1)
    usable = np.isfinite(ranges) & (ranges > 0.0)
    directions = points[usable] / ranges[usable, None]
    if len(directions) < _FEWEST:
        return np.eye(3)
    fine = directions[:: max(1, len(directions) // _FINE_DIRECTIONS)]
    about_z = float(_spreads(fine, np.eye(3)[2:])[0])
    if about_z < _WIDE:
        return np.eye(3)
    axes = np.concatenate([np.eye(3), fibonacci_lattice((np.arange(_AXES) + 0.5) / _AXES)])
    axis = axes[int(np.argmin(_spreads(directions[:: max(1, len(directions) // _DIRECTIONS)], axes)))]
    axis, spread = _refined(axis, fine)
    own = _spreads(fine, np.eye(3))
    if own.min() < spread + _SAME:
        axis, spread = np.eye(3)[int(np.argmin(own))], float(own.min())
    return np.eye(3) if spread > about_z - _NARROWER else levelling(_upwards(axis, fine))


def _upwards(axis: FloatArray, directions: FloatArray) -> FloatArray:
    """The axis (3,), or the opposite one: that which is nearer to z; far from it, that with more points below."""
    side = axis[2] if abs(axis[2]) > 0.5 else -np.median(directions @ axis)
    return axis if side > 0.0 else -axis


def _spreads(directions: FloatArray, axes: FloatArray) -> FloatArray:
    """(K,) range of the elevations of unit vectors (N, 3) above the equators of axes (K, 3), without strays."""
    sines = np.sort(axes @ directions.T, axis=1)
    strays = int(_STRAY_SHARE * len(directions))
    low, high = np.arcsin(np.clip(sines[:, [strays, -1 - strays]], -1.0, 1.0)).T
    return np.asarray(high - low, dtype=np.float64)


def _refined(axis: FloatArray, directions: FloatArray) -> tuple[FloatArray, float]:
    """The axis (3,) of the least spread near an axis, and the spread."""
    spread, step = float(_spreads(directions, axis[None])[0]), _FIRST_STEP
    while step > _LAST_STEP:
        across = np.linalg.svd(axis[None])[2][1:]
        tried = axis + step * np.concatenate([across, -across])
        tried /= np.linalg.norm(tried, axis=1, keepdims=True)
        spreads = _spreads(directions, tried)
        best = int(np.argmin(spreads))
        if spreads[best] < spread:
            axis, spread = tried[best], float(spreads[best])
        else:
            step *= 0.5
    return axis, spread


def fibonacci_lattice(z: FloatArray) -> FloatArray:
    """Unit vectors (N, 3) with evenly spaced z (N,): they lie evenly over that part of the sphere."""
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * (np.arange(len(z)) + 0.5)
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])
