"""Motions of a body through a world: carriers, their attitude on the ground, and given trajectories."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.trajectory import Trajectory
from lidarslam.simulation.world import World, choose

# Columns of `Motion.base`.
CHANNELS = ("x", "y", "z", "roll", "pitch", "yaw", "activity")


Sway = tuple[tuple[int, float, float, float], ...]
"""Sines on top of a motion, in the body's frame; they grow with the motion's activity and vanish at rest.

Each: the index into x, y, z, roll, pitch, yaw; amplitude in metres or radians; frequency in Hz; phase.
"""


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of a body, x forwards and z up, whose origin is on the ground under it (or which flies).

    Cubic splines go through `base`: world position, roll, pitch, yaw and activity (0 to 1), with
    R_world_body = Rz(yaw) Ry(pitch) Rx(roll).
    """

    name: str  # of the carrier, or "given"
    times: FloatArray  # (K,) from 0 to `duration_s`
    base: FloatArray  # (K, 7)
    sensor_height_m: float  # of a LiDAR above the body's origin
    sway: Sway = ()
    repeats: bool = True  # another lap follows a lap; else the body stays where it is in the end
    rests: bool = True  # a lap begins and ends at rest; else its last pose is its first, whole turns of yaw aside

    @property
    def duration_s(self) -> float:
        """Time of one lap."""
        return float(self.times[-1])

    @cached_property
    def _spline(self) -> "CubicSpline[np.float64]":
        if self.repeats and not self.rests:
            return _closed_spline(self.times, self.base)
        return CubicSpline(self.times, self.base, bc_type="clamped" if self.repeats else "natural")

    def pose_at(self, times: FloatArray) -> FloatArray:
        """T_world_body (N, 4, 4) at times (N,), seconds from the start; twice differentiable."""
        since = np.maximum(times, 0.0)
        lap_time = np.mod(since, self.duration_s) if self.repeats else np.minimum(since, self.duration_s)
        state = self._spline(lap_time)
        deflections = np.zeros((len(times), 6))
        for axis, amplitude, frequency_hz, phase in self.sway:
            deflections[:, axis] += amplitude * np.sin(2.0 * np.pi * frequency_hz * times + phase)
        x, y, z, roll, pitch, yaw = (state[:, :6] + state[:, 6:] * deflections).T
        # Sway along x and y is the body's, not the world's.
        c, s = np.cos(yaw), np.sin(yaw)
        dx, dy = x - state[:, 0], y - state[:, 1]
        position = np.stack([state[:, 0] + c * dx - s * dy, state[:, 1] + s * dx + c * dy, z], axis=-1)
        return make_transform(rotations(roll, pitch, yaw), position)


def _closed_spline(times: FloatArray, values: FloatArray) -> "CubicSpline[np.float64]":
    """Through values (K, D) at times (K,), with equal derivatives at either end: a periodic spline and a trend."""
    slope = (values[-1] - values[0]) / times[-1]
    level = values - np.multiply.outer(times, slope)
    level[-1] = level[0]
    spline = CubicSpline(times, level, bc_type="periodic")
    spline.c[2] += slope
    spline.c[3] += np.multiply.outer(times[:-1], slope)
    return spline


def rotations(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Rz(yaw) Ry(pitch) Rx(roll), (N, 3, 3), of angles (N,) in radians."""
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (np.cos, np.sin))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0).copy()


@dataclass(frozen=True)
class Swing:
    """One sine of a carrier's sway."""

    axis: str  # "x", "y", "z" (metres; forwards, left, up), "roll", "pitch" or "yaw" (degrees)
    amplitude: float
    frequency_hz: float  # before the seed varies it by a tenth
    stepwise: bool = False  # all such swings follow the carrier's gait, at one common frequency


@dataclass(frozen=True)
class Carrier:
    """A kind of motion, by its name on the command line."""

    name: str
    speed_mps: float  # unless limits or bends slow it down
    acceleration: float  # limits along and across, m/s^2
    side_acceleration: float
    turn_rate_deg: float  # about z, degrees a second (squared)
    turn_acceleration_deg: float
    stop_angle_deg: float  # at sharper corners it stops and turns on the spot
    half_width_m: float  # of its body, for staying within the route's free side
    footprint_m: float  # radius over which it averages the ground
    sensor_height_m: float  # of the LiDAR above the body's origin, which is on the ground or is the flying body
    smoothing_s: float  # half the time over which accelerations set in
    swings_deg: tuple[float, ...] = ()  # turns there and back before it takes a corner's new direction
    leans_with_ground: bool = True  # takes the ground's pitch and roll
    banks: bool = False  # leans into its accelerations, as aircraft must
    keeps_going: bool = False  # is at speed when a lap begins and ends; else laps begin and end at rest
    flight_height_m: float = 0.0  # above the ground, where the route is high enough; 0 for ground carriers
    sway: tuple[Swing, ...] = ()  # while it moves


_SUSPENSION = (Swing("pitch", 0.25, 1.3), Swing("roll", 0.25, 1.1), Swing("z", 0.01, 1.3))
_RUMBLE = (Swing("z", 0.0015, 6.0), Swing("roll", 0.25, 4.3), Swing("pitch", 0.25, 5.1))
# Heights: 1.73 m is KITTI's. The legged robot's gait of 2 Hz and its amplitudes are those of a trotting quadruped of
# 30 to 50 kg, the pedestrian's of a LiDAR on a hand-held stick; both are round figures, not measurements.
_TABLE = (
    Carrier("car", 12.0, 1.8, 2.4, 45.0, 60.0, 135.0, 1.0, 1.3, 1.73, smoothing_s=0.5, sway=_SUSPENSION),
    Carrier(
        "handheld", 1.3, 0.8, 1.0, 80.0, 200.0, 135.0, 0.3, 0.4, 1.5, smoothing_s=0.3, leans_with_ground=False,
        sway=(
            Swing("z", 0.02, 1.8, stepwise=True), Swing("y", 0.02, 0.9, stepwise=True),
            Swing("pitch", 1.5, 1.8, stepwise=True), Swing("roll", 1.5, 0.9, stepwise=True),
            Swing("yaw", 8.0, 0.23), Swing("pitch", 4.0, 0.31), Swing("roll", 3.0, 0.37), Swing("y", 0.06, 0.13),
        ),
    ),
    Carrier(
        "legged", 1.1, 0.8, 0.8, 70.0, 200.0, 135.0, 0.35, 0.5, 0.75, smoothing_s=0.3,
        sway=(
            Swing("z", 0.02, 2.0, stepwise=True), Swing("y", 0.015, 2.0, stepwise=True),
            Swing("roll", 2.5, 2.0, stepwise=True), Swing("pitch", 1.8, 2.0, stepwise=True),
            Swing("yaw", 1.0, 2.0, stepwise=True), Swing("y", 0.05, 0.11),
        ),
    ),
    Carrier("tracked", 1.2, 0.8, 1.0, 120.0, 500.0, 10.0, 0.35, 0.4, 0.6, smoothing_s=0.06, sway=_RUMBLE),
    Carrier(
        "tracked-harsh", 1.2, 0.8, 1.0, 180.0, 900.0, 10.0, 0.35, 0.4, 0.6, smoothing_s=0.06,
        swings_deg=(90.0, -90.0), sway=_RUMBLE,
    ),
    Carrier(
        "drone", 2.5, 1.5, 1.5, 60.0, 150.0, 135.0, 0.4, 1.5, 0.0, smoothing_s=0.4, leans_with_ground=False,
        banks=True, flight_height_m=2.0,
        sway=(
            Swing("z", 0.25, 0.09), Swing("y", 0.08, 0.17), Swing("x", 0.03, 0.29), Swing("yaw", 3.0, 0.13),
            Swing("roll", 0.6, 0.9), Swing("pitch", 0.6, 0.8),
        ),
    ),
    Carrier(
        "car-fast", 20.0, 2.5, 3.5, 45.0, 60.0, 135.0, 1.0, 1.3, 1.73, smoothing_s=0.5, keeps_going=True,
        sway=_SUSPENSION,
    ),
    # Accelerations of 3.3 m/s^2 take a bank of 18.6 degrees; with the sway it is 20.
    Carrier(
        "drone-agile", 7.0, 3.3, 3.3, 140.0, 500.0, 135.0, 0.4, 1.5, 0.0, smoothing_s=0.3, leans_with_ground=False,
        banks=True, flight_height_m=2.0,
        sway=(
            Swing("z", 0.25, 0.17), Swing("y", 0.08, 0.23), Swing("yaw", 4.0, 0.21),
            Swing("roll", 0.8, 1.1), Swing("pitch", 0.8, 0.9),
        ),
    ),
)  # fmt: skip
CARRIERS: dict[str, Carrier] = {carrier.name: carrier for carrier in _TABLE}

# Rotations of the LiDAR on the body: rotation vectors, degrees. Tilted: facing down to the front and a little sideways.
MOUNTS: dict[str, tuple[float, float, float]] = {
    "upright": (0.0, 0.0, 0.0),
    "upside-down": (180.0, 0.0, 0.0),
    "tilted": (6.0, 25.0, 0.0),
}


def mount_pose(name: str, height_m: float) -> FloatArray:
    """T_body_lidar (4, 4) of a LiDAR mounted so, that far above the body's origin."""
    R = Rotation.from_rotvec(np.deg2rad(choose("mount", name, MOUNTS))).as_matrix()
    return make_transform(R, [0.0, 0.0, height_m])


_SAMPLES = 24
_BLOCK = 4096


def ground_under(world: World, xy: FloatArray, radius_m: float) -> tuple[FloatArray, FloatArray]:
    """Planes that fit the ground within a radius of (N, 2) positions, by weighted least squares.

    Their heights (N,) at the positions, and their slopes (N, 2), the rise for each metre in x and y.

    Samples are spread over the disc like the seeds of a sunflower, with weights that vanish at its rim: triangle edges
    pass gently under the body.
    """
    k = np.arange(_SAMPLES) + 0.5
    angle = np.pi * (1.0 + 5.0**0.5) * k
    disc = np.sqrt(k / _SAMPLES)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    weights = (1.0 - (disc**2).sum(axis=1)) ** 2
    weights /= weights.sum()
    offsets = radius_m * disc
    offsets -= weights @ offsets
    fit = np.linalg.solve(offsets.T @ (weights[:, None] * offsets), (weights[:, None] * offsets).T)
    heights = np.empty((len(xy), _SAMPLES))
    for start in range(0, len(xy), _BLOCK):
        samples = xy[start : start + _BLOCK, None] + offsets
        heights[start : start + _BLOCK] = world.ground_at(samples.reshape(-1, 2)).reshape(-1, _SAMPLES)
    return heights @ weights, heights @ fit.T


def motion_along(trajectory: Trajectory) -> Motion:
    """Follow the poses of a trajectory in its own time, on smooth splines; after the last the body stays where it is.

    The trajectory's world frame is the world's, and its poses, of a frame with x forwards and z up, look up or down by
    less than 90 degrees.
    """
    yaw, pitch, roll = np.unwrap(Rotation.from_matrix(trajectory.T_world_lidar[:, :3, :3]).as_euler("ZYX"), axis=0).T
    base = np.column_stack([trajectory.positions, roll, pitch, yaw, np.zeros(len(trajectory))])
    return Motion("given", trajectory.stamps - trajectory.stamps[0], base, 0.0, repeats=False)
