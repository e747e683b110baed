"""Vegetation: trees, bushes, hedges and grass; plants are drawn in their own frame, the foot at the origin, z up."""

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Grass, HeightField
from lidarslam.simulation.worlds.building import Builder, smooth_noise

# Roots go this far down, so that nothing hovers on a slope.
SUNK_M = 0.4
# Of meadows: at 10 degrees of incidence a ray sees half a decimetre deep.
_FREE_PATH_M = 0.3
_EDGE_M = 0.6


def grass(rng: np.random.Generator, ground: HeightField, height_m: FloatArray, distance_m: FloatArray) -> Grass:
    """Tussocks on the ground's grid (X, Y).

    Args:
        rng: of the tussocks.
        ground: gives the grid.
        height_m: (X, Y) mean height of the blades, 0 where none grow.
        distance_m: (X, Y) from where the ground is kept free of grass, negative there.
    """
    shape = ground.heights.shape
    tussocks = 1.0 + 0.3 * smooth_noise(rng, shape, 1.0) + 0.3 * smooth_noise(rng, shape, 8.0)
    heights = height_m * np.clip(tussocks, 0.2, 2.0) * np.clip(distance_m / _EDGE_M, 0.0, 1.0)
    return Grass(HeightField(ground.origin_xy, ground.cell_m, heights), _FREE_PATH_M)


def leaf_clump(
    part: Builder, rng: np.random.Generator, centre: FloatArray, radii: FloatArray, count: int, leaf_m: float
) -> None:
    """Flat boxes of any rotation, scattered in an ellipsoid of semi-axes `radii` (3,), denser towards its surface."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    centres = centre + radii * direction * rng.uniform(0.2, 1.0, (count, 1)) ** 0.5
    sizes = leaf_m * rng.uniform([0.7, 0.5, 0.05], [1.3, 1.0, 0.2], (count, 3))
    turns = Rotation.from_quat(rng.standard_normal((count, 4))).as_matrix()
    for at, size, turn in zip(centres, sizes, turns, strict=True):
        part.box(at, size, R=turn)


def broadleaf(rng: np.random.Generator, height: float, trunk_radius: float, leaves: int) -> Builder:
    """A tree with a bare trunk for two fifths of its height, forking into boughs that carry a round crown."""
    part = Builder()
    lean = np.array([*rng.normal(0.0, 0.035, 2), 1.0])
    fork, middle = rng.uniform(0.36, 0.44) * height * lean, 0.68 * height * lean
    part.cylinder(-SUNK_M * lean, fork, trunk_radius)
    part.cylinder(fork, 0.8 * height * lean, 0.5 * trunk_radius)
    crown = height * np.array([rng.uniform(0.22, 0.3), rng.uniform(0.22, 0.3), 0.3])
    boughs = int(rng.integers(4, 7))
    leaf_m = 0.4 * height / np.sqrt(leaves)  # the fewer, the larger, so that all crowns are about as dense
    for angle in rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(boughs) / boughs:
        outward = np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.2, 0.5)])
        tip = middle + 0.7 * crown * outward
        part.cylinder(fork * rng.uniform(0.93, 1.15), tip, 0.3 * trunk_radius)
        leaf_clump(part, rng, tip, 0.45 * crown, leaves // (boughs + 1), leaf_m)
    leaf_clump(part, rng, middle, crown, leaves - boughs * (leaves // (boughs + 1)), leaf_m)
    return part


def conifer(rng: np.random.Generator, height: float, trunk_radius: float, leaves: int) -> Builder:
    """A straight tree: dead stubs on the lower trunk, and above a cone of drooping boughs."""
    part = Builder()
    lean = np.array([*rng.normal(0.0, 0.05, 2), 1.0])
    half = 0.5 * height * lean
    part.cylinder(-SUNK_M * lean, half, trunk_radius)
    part.cylinder(half, height * lean, 0.55 * trunk_radius)
    for _ in range(int(rng.integers(2, 6))):
        angle, foot = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(1.2, 0.4 * height) * lean
        reach = trunk_radius + rng.uniform(0.3, 1.1)
        tip = foot + reach * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.25, 0.25)])
        part.cylinder(foot, tip, rng.uniform(0.015, 0.03))
    low = rng.uniform(0.25, 0.4)
    angles = rng.uniform(0.0, 2.0 * np.pi) + 2.4 * np.arange(leaves)  # the golden angle spreads them evenly
    for angle, level in zip(angles, np.linspace(low, 0.95, leaves), strict=True):
        reach = 0.26 * height * (1.0 - level) * rng.uniform(0.8, 1.2) + 0.4
        outward = np.array([np.cos(angle), np.sin(angle), -rng.uniform(0.2, 0.5)])
        foot = level * height * lean
        part.beam(foot, foot + reach * outward, rng.uniform(0.25, 0.4) * reach, 0.06)
    return part


def bush(rng: np.random.Generator, radius: float, leaves: int) -> Builder:
    """A clump of small boxes, about as wide as high."""
    part = Builder()
    high = rng.uniform(0.7, 1.1) * radius
    middle, radii = np.array([0.0, 0.0, 0.55 * high]), np.array([radius, radius, 0.75 * high])
    leaf_clump(part, rng, middle, radii, leaves, 0.4 * radius)
    part.pole((0.0, 0.0), (-SUNK_M, high), 0.08 * radius)
    return part


def hedge(rng: np.random.Generator, length: float, height: float, thickness: float) -> Builder:
    """A clipped hedge along x, from 0 to `length`, of uneven blocks about 0.8 m long."""
    part = Builder()
    for a, b in pairwise(np.linspace(0.0, length, max(2, round(length / 0.8) + 1))):
        top = height + rng.normal(0.0, 0.04)
        size = (b - a + 0.1, thickness * rng.uniform(0.85, 1.1), top + SUNK_M)
        part.box((0.5 * (a + b), rng.normal(0.0, 0.03), 0.5 * (top - SUNK_M)), size, yaw=rng.normal(0.0, 0.05))
    return part


def fallen_trunk(rng: np.random.Generator, length: float, radius: float) -> Builder:
    """A lying trunk along x, its middle at the origin, half sunk, with stubs of boughs and a plate of roots."""
    part = Builder()
    half, low = 0.5 * length, 0.6 * radius
    part.cylinder((-half, 0.0, low), (0.1 * half, 0.0, low), radius)
    part.cylinder((0.1 * half, 0.0, low), (half, 0.0, low), 0.75 * radius)
    for x in rng.uniform(-0.2 * half, 0.9 * half, int(rng.integers(2, 5))):
        angle = rng.uniform(0.2, np.pi - 0.2)
        tip = np.array([x + 0.3, np.cos(angle), low + np.sin(angle)]) * [1.0, 0.9, 0.9]
        part.cylinder((x, 0.0, low), tip, 0.12 * radius + 0.01)
    if rng.random() < 0.5:
        roots = Rotation.from_rotvec([0.0, 0.15, 0.1]).as_matrix()
        part.box((-half, 0.0, low + 0.2), (0.35, 5.0 * radius, 4.5 * radius), R=roots)
    return part
