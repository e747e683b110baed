"""Carriers of the LiDAR: speeds, corners, sway, and how the LiDAR is mounted."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.simulation.choices import choose


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
    speed_mps: float  # where nothing slows it down
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
    banks: bool = False  # leans into its accelerations, as what flies must
    keeps_going: bool = False  # is at speed when a lap begins and ends; else laps begin and end at rest
    flight_height_m: float = 0.0  # above the ground, where the route is high enough; 0 for what does not fly
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

# Rotations of the LiDAR on the body: rotation vectors, degrees. Tilted: looking down to the front and a little aside.
MOUNTS: dict[str, tuple[float, float, float]] = {
    "upright": (0.0, 0.0, 0.0),
    "upside-down": (180.0, 0.0, 0.0),
    "tilted": (6.0, 25.0, 0.0),
}


def find_carrier(name: str) -> Carrier:
    """The carrier of that name."""
    return choose("motion", name, CARRIERS)


def mount_pose(name: str, height_m: float) -> FloatArray:
    """T_body_lidar (4, 4) of a LiDAR mounted so, that far above the body's origin."""
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(np.deg2rad(choose("mount", name, MOUNTS))).as_matrix()
    return make_transform(R, [0.0, 0.0, height_m])
