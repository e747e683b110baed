"""Outdoor furniture: cars, people, poles, benches; each drawn in its own frame, the origin on the ground, z up."""

import numpy as np
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.simulation.world import HeightField
from lidarslam.simulation.worlds.building import Builder, rotation_z

# Feet go this far down, so that nothing hovers on a slope.
SUNK_M = 0.3


def upright(ground: HeightField, xy: FloatArray, yaw: float) -> FloatArray:
    """T_world_part (4, 4) of a part that stands plumb at (2,), whatever the slope."""
    return make_transform(rotation_z(yaw), np.append(xy, ground.height_at(np.asarray(xy)[None])))


def on_slope(ground: HeightField, xy: FloatArray, yaw: float, length: float, width: float) -> FloatArray:
    """T_world_part (4, 4) of a part of that size that stands on the ground with all of its feet, such as a car."""
    R = rotation_z(yaw)
    ahead, left = 0.5 * length * R[:2, 0], 0.5 * width * R[:2, 1]
    z = ground.height_at(xy + np.stack([ahead, -ahead, left, -left]))
    x_axis = np.append(2.0 * ahead, z[0] - z[1])
    normal = np.cross(x_axis, np.append(2.0 * left, z[2] - z[3]))
    x_axis, normal = x_axis / np.linalg.norm(x_axis), normal / np.linalg.norm(normal)
    return make_transform(np.stack([x_axis, np.cross(normal, x_axis), normal], axis=1), np.append(xy, z.mean()))


def car(rng: np.random.Generator, round_wheels: bool = True) -> Builder:
    """A car or, one time in six, a van, facing x: at most 5 m long, 1.95 m wide; movers take boxes for wheels."""
    part = Builder()
    is_van = rng.random() < 1.0 / 6.0
    length, width = (rng.uniform(4.6, 5.0), 1.92) if is_van else (rng.uniform(3.7, 4.7), rng.uniform(1.66, 1.84))
    a, b = 0.5 * length, 0.5 * width
    waist, roof = (1.05, rng.uniform(1.9, 2.3)) if is_van else (rng.uniform(0.82, 0.95), rng.uniform(1.4, 1.55))
    bonnet, boot = rng.uniform(0.26, 0.32) * length, rng.uniform(0.06, 0.2) * length
    if is_van:
        bonnet, boot = 0.25 * length, 0.02
    part.block((-a, -b, 0.22), (a, b, waist - 0.12))
    part.block((-a + 0.1, -b + 0.05, waist - 0.2), (a - bonnet + 0.1, b - 0.05, waist))
    part.block((a - bonnet, -b + 0.08, waist - 0.3), (a - 0.15, b - 0.08, waist - 0.06))
    slant = 0.35 if is_van else 0.5
    front, back = a - bonnet - slant, -a + boot + 0.3 * (not is_van)
    part.block((back, -b + 0.1, waist - 0.1), (front, b - 0.1, roof))
    for foot, head in ((front + slant, front - 0.03), (back - 0.28 * (not is_van) - 0.03, back + 0.02)):
        part.beam((foot, 0.0, waist - 0.06), (head, 0.0, roof - 0.05), width - 0.22, 0.08)
    for side in (-1.0, 1.0):
        part.box((front + 0.1, side * (b + 0.08), waist + 0.06), (0.12, 0.18, 0.14))
    for x in (-0.62 * a, 0.64 * a):
        for side in (-1.0, 1.0):
            if round_wheels:
                part.cylinder((x, side * (b - 0.2), 0.31), (x, side * (b + 0.01), 0.31), 0.33)
            else:
                part.box((x, side * (b - 0.1), 0.3), (0.56, 0.22, 0.68))
    return part


def pedestrian(rng: np.random.Generator) -> Builder:
    """A pedestrian walking towards x, in a few boxes."""
    part = Builder()
    tall = rng.uniform(0.88, 1.06)
    for side in (-1.0, 1.0):
        stride = side * rng.uniform(0.08, 0.16)
        part.beam((2.2 * stride, side * 0.09, -0.05), (0.0, side * 0.09, 0.88 * tall), 0.14, 0.16)
        part.beam((-1.8 * stride, side * 0.27, 0.8 * tall), (0.0, side * 0.25, 1.42 * tall), 0.09, 0.1)
    part.block((-0.12, -0.21, 0.82 * tall), (0.13, 0.21, 1.46 * tall))
    part.block((-0.09, -0.08, 1.46 * tall), (0.11, 0.08, 1.75 * tall))
    return part


def lamp_post(height: float, reach: float) -> Builder:
    """A tapering lamp post with its arm along x; with no reach, a lantern on top."""
    part = Builder()
    part.pole((0.0, 0.0), (-SUNK_M, 1.1), 0.1)
    part.pole((0.0, 0.0), (1.1, height), 0.065)
    if reach > 0.0:
        tip = (reach, 0.0, height + 0.25)
        part.cylinder((0.0, 0.0, height - 0.05), tip, 0.045)
        part.box(tip, (0.7, 0.28, 0.13))
    else:
        part.block((-0.22, -0.22, height - 0.05), (0.22, 0.22, height + 0.35))
        part.block((-0.3, -0.3, height + 0.35), (0.3, 0.3, height + 0.42))
    return part


def sign(rng: np.random.Generator) -> Builder:
    """A traffic sign, its plate facing x."""
    part = Builder()
    size, top = rng.uniform(0.5, 0.8), rng.uniform(2.2, 2.8)
    part.pole((0.0, 0.0), (-SUNK_M, top + 0.05), 0.035)
    turn = Rotation.from_euler("x", rng.choice([0.0, 0.25 * np.pi])).as_matrix()
    part.box((0.05, 0.0, top - 0.5 * size), (0.025, size, size), R=turn)
    if rng.random() < 0.4:
        part.block((0.04, -0.3, top - 1.8 * size), (0.06, 0.3, top - 1.8 * size + 0.22))
    return part


def bench(rng: np.random.Generator) -> Builder:
    """A bench that looks towards x: three slats to sit on, two to lean on, two feet."""
    part = Builder()
    half = 0.5 * rng.uniform(1.5, 2.0)
    for x in (-0.2, -0.02, 0.16):
        part.block((x, -half, 0.43), (x + 0.13, half, 0.47))
    for z in (0.6, 0.76):
        part.block((-0.3, -half, z), (-0.26, half, z + 0.12))
    for y in (-half + 0.2, half - 0.2):
        part.block((-0.22, y - 0.05, -SUNK_M), (0.26, y + 0.05, 0.43))
        part.block((-0.27, y - 0.04, 0.35), (-0.2, y + 0.04, 0.86))
    return part


def bin_row(rng: np.random.Generator, count: int) -> Builder:
    """Wheeled bins in a row along y, their lids a little proud."""
    part = Builder()
    for k in range(count):
        y, high, turn = 0.75 * (k - 0.5 * (count - 1)), rng.uniform(0.95, 1.15), rng.normal(0.0, 0.08)
        part.box((0.0, y, 0.5 * high - 0.05), (0.6, 0.55, high + 0.1), yaw=turn)
        part.box((0.0, y, high + 0.03), (0.68, 0.6, 0.06), yaw=turn)
    return part


def litter_bin() -> Builder:
    """A round litter bin."""
    part = Builder()
    for z, radius in (((-SUNK_M, 0.85), 0.24), ((0.95, 1.0), 0.26), ((0.8, 1.0), 0.03)):
        part.pole((0.0, 0.0), z, radius)
    return part


def bus_shelter(rng: np.random.Generator) -> Builder:
    """A shelter open towards x, its back along y."""
    part = Builder()
    half = 0.5 * rng.uniform(3.0, 4.2)
    part.block((-0.75, -half, 2.35), (0.7, half, 2.47))
    part.block((-0.72, -half, 0.15), (-0.68, half, 2.35))
    part.block((-0.7, half - 0.05, 0.15), (0.35, half, 2.35))
    part.block((-0.6, -0.6 * half, 0.42), (-0.25, 0.6 * half, 0.48))
    for x, y in ((-0.7, -half + 0.05), (-0.7, half - 0.05), (0.6, -half + 0.05), (0.6, half - 0.05), (-0.5, 0.0)):
        part.pole((x, y), (-SUNK_M, 2.4 if y else 0.44), 0.04)
    return part


def log_pile(rng: np.random.Generator, rows: int) -> Builder:
    """Logs along x, stacked `rows` wide at the bottom, between two stakes."""
    part = Builder()
    half, radius = 0.5 * rng.uniform(2.0, 4.0), rng.uniform(0.14, 0.22)
    for level in range(rows):
        for k in range(rows - level):
            y, z = (2.0 * k - (rows - level - 1)) * radius, radius * (0.7 + 1.74 * level)
            shift, r = rng.normal(0.0, 0.08), radius * rng.uniform(0.85, 1.0)
            part.cylinder((shift - half, y, z), (shift + half, y, z), r)
    for x in (-0.6 * half, 0.6 * half):
        for side in (-1.0, 1.0):
            part.pole((x, side * (rows * radius + 0.06)), (-SUNK_M, 1.3), 0.05)
    return part
