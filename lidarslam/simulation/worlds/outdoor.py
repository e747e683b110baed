"""Cars, people, poles, trees, hedges, grass, houses; each drawn in its own frame, the origin on the ground, z up."""

from dataclasses import dataclass, field
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, make_transform, rotation_z
from lidarslam.simulation.world import Grass, HeightField, Route
from lidarslam.simulation.worlds import paths
from lidarslam.simulation.worlds.building import Builder, heading, smooth_noise, starting

# Feet extend this far down, so that nothing hovers on a slope.
SUNK_M = 0.3


def beside(rng: np.random.Generator, nearest_m: float, farthest_m: float) -> float:
    """A distance to either side, positive to the left."""
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(nearest_m, farthest_m))


@dataclass(frozen=True)
class Grounds:
    """What stands and grows on the ground beside a closed path; what is green is pruned along the route."""

    rng: np.random.Generator
    path: FloatArray  # (M, 2)
    ground: HeightField
    solid: Builder = field(default_factory=Builder)
    green: Builder = field(default_factory=Builder)

    def put(self, part: Builder, xy: FloatArray, yaw: float | None = None, is_green: bool = False) -> None:
        """Add a part that stands upright at (2,); without a yaw it is turned at random."""
        yaw = self.rng.uniform(0.0, 2.0 * np.pi) if yaw is None else yaw
        (self.green if is_green else self.solid).place(part, upright(self.ground, xy, yaw))

    def beside(self, index: int, left_m: float) -> tuple[FloatArray, float]:
        """A place (2,) to the left of a point of the path, counted round and round, and the path's heading there."""
        path, count = self.path, len(self.path)
        yaw = heading(path[(index % count + 1) % count] - path[index % count - 1])
        return path[index % count] + left_m * np.array([-np.sin(yaw), np.cos(yaw)]), yaw

    def off_path(self, xy: FloatArray) -> float:
        """Distance of the nearest of points (..., 2) from the path."""
        return float(paths.distance_to_loop(np.atleast_2d(xy), self.path).min())

    def prune(self, route: Route, margin_m: float = 0.1) -> None:
        """Add what is green to what is solid, without what reaches into the route's free space."""
        self.solid.place(paths.prune(self.green, route, margin_m), np.eye(4))


def upright(ground: HeightField, xy: FloatArray, yaw: float) -> FloatArray:
    """T_world_part (4, 4) of a part that stands upright at (2,), whatever the slope."""
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
    bonnet, boot = (0.25 * length, 0.02) if is_van else (bonnet, boot)
    slant = 0.35 if is_van else 0.5
    front, back = a - bonnet - slant, -a + boot + 0.3 * (not is_van)
    part.blocks(
        (a, b, 0.22, waist - 0.12), (-a + 0.1, a - bonnet + 0.1, b - 0.05, waist - 0.2, waist),
        (a - bonnet, a - 0.15, b - 0.08, waist - 0.3, waist - 0.06), (back, front, b - 0.1, waist - 0.1, roof),
    )  # fmt: skip
    for foot, head in ((front + slant, front - 0.03), (back - 0.28 * (not is_van) - 0.03, back + 0.02)):
        part.beam((foot, 0.0, waist - 0.06), (head, 0.0, roof - 0.05), width - 0.22, 0.08)
    for side in (-1.0, 1.0):
        part.box((front + 0.1, side * (b + 0.08), waist + 0.06), (0.12, 0.18, 0.14))
    for x, side in product((-0.62 * a, 0.64 * a), (-1.0, 1.0)):
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
    part.blocks((-0.12, 0.13, 0.21, 0.82 * tall, 1.46 * tall), (-0.09, 0.11, 0.08, 1.46 * tall, 1.75 * tall))
    return part


def lamp_post(height: float, reach: float) -> Builder:
    """A tapering lamp post with its arm along x; with no reach, a lantern on top."""
    part = Builder()
    part.poles((0.0, 0.0, -SUNK_M, 1.1, 0.1), (0.0, 0.0, 1.1, height, 0.065))
    if reach > 0.0:
        tip = (reach, 0.0, height + 0.25)
        part.cylinder((0.0, 0.0, height - 0.05), tip, 0.045)
        part.box(tip, (0.7, 0.28, 0.13))
    else:
        part.blocks((0.22, 0.22, height - 0.05, height + 0.35), (0.3, 0.3, height + 0.35, height + 0.42))
    return part


def sign(rng: np.random.Generator) -> Builder:
    """A traffic sign, its plate facing x."""
    part = Builder()
    size, top = rng.uniform(0.5, 0.8), rng.uniform(2.2, 2.8)
    part.pole((0.0, 0.0), (-SUNK_M, top + 0.05), 0.035)
    turn = Rotation.from_euler("x", rng.choice([0.0, 0.25 * np.pi])).as_matrix()
    part.box((0.05, 0.0, top - 0.5 * size), (0.025, size, size), R=turn)
    if rng.random() < 0.4:
        part.block((0.04, 0.06), (-0.3, 0.3), (top - 1.8 * size, top - 1.8 * size + 0.22))
    return part


def bench(rng: np.random.Generator) -> Builder:
    """A bench that looks towards x: three slats to sit on, two to lean on, two feet."""
    part = Builder()
    half = 0.5 * rng.uniform(1.5, 2.0)
    part.block(starting((-0.2, -0.02, 0.16), 0.13), (-half, half), (0.43, 0.47))
    part.block((-0.3, -0.26), (-half, half), starting((0.6, 0.76), 0.12))
    for y in (-half + 0.2, half - 0.2):
        part.block((-0.22, 0.26), (y - 0.05, y + 0.05), (-SUNK_M, 0.43))
        part.block((-0.27, -0.2), (y - 0.04, y + 0.04), (0.35, 0.86))
    return part


def bin_row(rng: np.random.Generator, count: int) -> Builder:
    """Wheeled bins in a row along y, with slightly protruding lids."""
    part = Builder()
    for k in range(count):
        y, high, turn = 0.75 * (k - 0.5 * (count - 1)), rng.uniform(0.95, 1.15), rng.normal(0.0, 0.08)
        part.box((0.0, y, 0.5 * high - 0.05), (0.6, 0.55, high + 0.1), yaw=turn)
        part.box((0.0, y, high + 0.03), (0.68, 0.6, 0.06), yaw=turn)
    return part


def litter_bin() -> Builder:
    """A round litter bin."""
    part = Builder()
    part.poles((0.0, 0.0, -SUNK_M, 0.85, 0.24), (0.0, 0.0, 0.95, 1.0, 0.26), (0.0, 0.0, 0.8, 1.0, 0.03))
    return part


def bus_shelter(rng: np.random.Generator) -> Builder:
    """A shelter open towards x, its back along y."""
    part = Builder()
    half = 0.5 * rng.uniform(3.0, 4.2)
    part.blocks(
        (-0.75, 0.7, half, 2.35, 2.47), (-0.72, -0.68, half, 0.15, 2.35),
        (-0.7, 0.35, half - 0.05, half, 0.15, 2.35), (-0.6, -0.25, 0.6 * half, 0.42, 0.48),
    )  # fmt: skip
    for x, y in ((-0.7, -half + 0.05), (-0.7, half - 0.05), (0.6, -half + 0.05), (0.6, half - 0.05), (-0.5, 0.0)):
        part.pole((x, y), (-SUNK_M, 2.4 if y else 0.44), 0.04)
    return part


def log_pile(rng: np.random.Generator, rows: int) -> Builder:
    """Logs along x, stacked `rows` wide at the bottom, between two stakes."""
    part = Builder()
    half, radius = 0.5 * rng.uniform(2.0, 4.0), rng.uniform(0.14, 0.22)
    for level, k in ((row, k) for row in range(rows) for k in range(rows - row)):
        y, z = (2.0 * k - (rows - level - 1)) * radius, radius * (0.7 + 1.74 * level)
        shift, r = rng.normal(0.0, 0.08), radius * rng.uniform(0.85, 1.0)
        part.cylinder((shift - half, y, z), (shift + half, y, z), r)
    for x in (-0.6 * half, 0.6 * half):
        part.poles(*((x, side * (rows * radius + 0.06), -SUNK_M, 1.3, 0.05) for side in (-1.0, 1.0)))
    return part


# Roots extend this far down, so that nothing hovers on a slope.
_ROOTS_M = 0.4
# Of meadows: at 10 degrees of incidence a ray sees half a decimetre deep.
_FREE_PATH_M = 0.3
_EDGE_M = 0.6


def grass(rng: np.random.Generator, ground: HeightField, height_m: FloatArray, distance_m: FloatArray) -> Grass:
    """Tussocks of mean height (X, Y) on the ground's grid, at a distance (X, Y) from where it is kept free of grass."""
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
    part.cylinder(-_ROOTS_M * lean, fork, trunk_radius)
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


def old_tree(rng: np.random.Generator) -> Builder:
    """A broadleaf tree of a meadow or a field."""
    return broadleaf(rng, rng.uniform(7.0, 13.0), rng.uniform(0.18, 0.4), 80)


def conifer(rng: np.random.Generator, height: float, trunk_radius: float, leaves: int) -> Builder:
    """A straight tree: dead stubs on the lower trunk, and above a cone of drooping boughs."""
    part = Builder()
    lean = np.array([*rng.normal(0.0, 0.05, 2), 1.0])
    half = 0.5 * height * lean
    part.cylinder(-_ROOTS_M * lean, half, trunk_radius)
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
    part.pole((0.0, 0.0), (-_ROOTS_M, high), 0.08 * radius)
    return part


def hedge(rng: np.random.Generator, length: float, height: float, thickness: float) -> Builder:
    """A clipped hedge along x, from 0 to `length`, of uneven blocks about 0.8 m long."""
    part = Builder()
    for a, b in pairwise(np.linspace(0.0, length, max(2, round(length / 0.8) + 1))):
        top = height + rng.normal(0.0, 0.04)
        size = (b - a + 0.1, thickness * rng.uniform(0.85, 1.1), top + _ROOTS_M)
        part.box((0.5 * (a + b), rng.normal(0.0, 0.03), 0.5 * (top - _ROOTS_M)), size, yaw=rng.normal(0.0, 0.05))
    return part


def fallen_trunk(rng: np.random.Generator, length: float, radius: float) -> Builder:
    """A lying trunk along x, its middle at the origin, half sunk, with stubs of boughs and a plate of roots."""
    part = Builder()
    half, low = 0.5 * length, 0.6 * radius
    for start, end, thick in ((-half, 0.1 * half, radius), (0.1 * half, half, 0.75 * radius)):
        part.cylinder((start, 0.0, low), (end, 0.0, low), thick)
    for x in rng.uniform(-0.2 * half, 0.9 * half, int(rng.integers(2, 5))):
        angle = rng.uniform(0.2, np.pi - 0.2)
        tip = np.array([x + 0.3, np.cos(angle), low + np.sin(angle)]) * [1.0, 0.9, 0.9]
        part.cylinder((x, 0.0, low), tip, 0.12 * radius + 0.01)
    if rng.random() < 0.5:
        roots = Rotation.from_rotvec([0.0, 0.15, 0.1]).as_matrix()
        part.box((-half, 0.0, low + 0.2), (0.35, 5.0 * radius, 4.5 * radius), R=roots)
    return part


# Walls go this far down: houses stand level on streets that slope.
_FOUNDATION_M = 2.0
# Faces that would be in one plane are set apart by this much.
_OFFSET_M = 0.02


class _Style(NamedTuple):
    """Measures that all facades of one house share."""

    storeys: int
    storey_m: float  # height of a storey
    recess_m: float  # of the windows behind the wall
    axis_m: float  # about the distance between windows
    opening: float  # share of it that is window
    sill_m: float  # lower and upper edge of a window above its floor
    lintel_m: float
    ground_sill_m: float  # the same on the ground floor
    ground_lintel_m: float

    @property
    def top_m(self) -> float:
        return self.storeys * self.storey_m + 0.3

    def openings(self, width: float) -> FloatArray:
        """(K, 2) where along a facade each column of windows starts and ends."""
        columns = max(1, round(width / self.axis_m))
        pitch = width / columns
        middle = pitch * (np.arange(columns) + 0.5)
        return middle[:, None] + 0.5 * self.opening * pitch * np.array([-1.0, 1.0])


def house(
    rng: np.random.Generator, width: float, depth: float, open_sides: tuple[bool, bool],
    storeys: tuple[int, int] = (2, 5), is_plain: bool = False,
) -> Builder:  # fmt: skip
    """A house between the fewest and most storeys, its left and right sides with windows where they are open.

    The origin is at the left end of its front as seen from within, x along the front, y into the house. A plain house
    has few wide windows and no ornaments, for streets of many kilometres.
    """
    part = Builder()
    style = _draw_style(rng, storeys, 3.0 if is_plain else 1.0)
    recess, top = style.recess_m, style.top_m
    x0, x1 = recess * open_sides[0], width - recess * open_sides[1]
    openings = style.openings(width)
    door = int(rng.integers(len(openings)))
    passage = bool(width > 9.0 and rng.random() < 0.2)
    if passage:  # a way through to the yard in place of the door
        middle = float(openings[door].mean())
        a, b = max(middle - 1.4, 0.4), min(middle + 1.4, width - 0.4)
        part.block([(x0, a), (b, x1)], (recess, depth), (-_FOUNDATION_M, 3.0))
        part.block((x0, x1), (recess, depth), (3.0, top))
        before, after = openings[openings[:, 1] < a - 0.1], openings[openings[:, 0] > b + 0.1]
        openings, door = np.concatenate([before, [[a, b]], after]), len(before)
    else:
        part.block((x0, x1), (recess, depth), (-_FOUNDATION_M, top))
    _facade(part, style, width, openings, door, passage)
    if not is_plain:
        _ornaments(part, rng, style, openings, door)
    for is_open, corner, yaw in zip(open_sides, ((0.0, depth), (width, 0.0)), (-0.5 * np.pi, 0.5 * np.pi), strict=True):
        if is_open:
            _facade(part.shifted(*corner, yaw=yaw), style, depth, style.openings(depth))
    _roof(part, rng, width, depth, top)
    return part


def _draw_style(rng: np.random.Generator, storeys: tuple[int, int], spread: float) -> _Style:
    storey = rng.uniform(2.9, 3.5)
    is_shop = rng.random() < 0.3
    sill = rng.uniform(0.7, 1.0)
    count, recess = int(rng.integers(*storeys, endpoint=True)), rng.uniform(0.14, 0.38)
    axis, opening = spread * rng.uniform(2.1, 3.4), rng.uniform(0.4, 0.62)
    lintel = rng.uniform(sill + 1.2, storey - 0.25)
    ground = (0.35, 2.6) if is_shop else (sill + 0.1, rng.uniform(2.2, 2.6))
    return _Style(count, storey, recess, axis, opening, sill, lintel, *ground)


def _facade(
    part: Builder, style: _Style, width: float, openings: FloatArray, door: int = -1, is_passage: bool = False
) -> None:
    """Piers between the columns of windows, bands between the storeys; the column `door` is open to the ground."""
    back, top = style.recess_m + _OFFSET_M, style.top_m
    for x0, x1 in np.concatenate([[0.0], openings.ravel(), [width]]).reshape(-1, 2):
        if x1 - x0 > 0.05:
            part.block((x0, x1), (0.0, back), (-_FOUNDATION_M, top))
    sills = [style.ground_sill_m, *(style.storey_m * k + style.sill_m for k in range(1, style.storeys)), top]
    lintels = [style.ground_lintel_m, *(style.storey_m * k + style.lintel_m for k in range(1, style.storeys))]
    part.block((0.01, width - 0.01), (_OFFSET_M, back), np.column_stack([lintels, sills[1:]]))
    stretches = np.array([0.01, *(openings[door] if door >= 0 else ()), width - 0.01])
    part.block(stretches, (_OFFSET_M, back), (-_FOUNDATION_M, sills[0]))
    if door >= 0 and not is_passage:
        part.block((openings[door, 0], openings[door, 1]), (-0.32, back), (-0.6, 0.14))


def _ornaments(part: Builder, rng: np.random.Generator, style: _Style, openings: FloatArray, door: int) -> None:
    """Downpipe, awning, and a bay or balconies on the upper floors."""
    end = float(openings[-1, 1])
    part.pole((rng.choice([0.12, end + 0.2]), -0.07), (-0.5, style.top_m - 0.1), 0.05)
    if style.ground_sill_m < 0.5 and rng.random() < 0.7:
        part.beam((0.5 * end, -rng.uniform(0.9, 1.3), 2.55), (0.5 * end, 0.05, 3.0), 0.85 * end, 0.05)
    elif rng.random() < 0.35:
        _bay(part, style, openings[int(rng.integers(len(openings)))], rng.uniform(0.5, 0.9))
    if rng.random() < 0.35:
        for column in np.flatnonzero(rng.random(len(openings)) < 0.3):
            for storey in range(1, style.storeys):
                if column != door and rng.random() < 0.7:
                    _balcony(part, openings[column], storey * style.storey_m, rng.uniform(0.8, 1.2))


def _bay(part: Builder, style: _Style, opening: FloatArray, reach: float) -> None:
    """A box with windows of its own before the upper floors of one column."""
    x0, x1 = opening[0] - 0.25, opening[1] + 0.25
    low, high = style.storey_m - 0.05, style.top_m - 0.4
    part.block((x0 + 0.1, x1 - 0.1), (-reach + 0.12, 0.1), (low, high))
    part.block(starting((x0, x1 - 0.16), 0.16), (-reach, -reach + 0.2), (low, high))
    for k in range(1, style.storeys + 1):
        z0 = low if k == 1 else (k - 1) * style.storey_m + style.lintel_m
        z1 = high if k == style.storeys else k * style.storey_m + style.sill_m
        if z1 - z0 > 0.05:
            part.block((x0 + _OFFSET_M, x1 - _OFFSET_M), (-reach + _OFFSET_M, 0.1), (z0, z1))


def _balcony(part: Builder, opening: FloatArray, floor: float, reach: float) -> None:
    x0, x1 = opening[0] - 0.3, opening[1] + 0.3
    part.blocks((x0, x1, -reach, 0.1, floor - 0.16, floor), (x0, x1, -reach, -reach + 0.05, floor + 0.95, floor + 1.0))
    part.block(starting((x0, x1 - 0.05), 0.04), (-reach + 0.06, 0.05), (floor + 0.1, floor + 1.0))
    bars = starting(np.linspace(x0, x1 - 0.04, max(3, round((x1 - x0) / 0.5))), 0.04)
    part.block(bars, (-reach + 0.01, -reach + 0.04), (floor - 0.02, floor + 0.96))


def _roof(part: Builder, rng: np.random.Generator, width: float, depth: float, top: float) -> None:
    """A cornice, and a flat roof behind a parapet or a pitched one with its eaves to the street; a chimney."""
    part.block((-0.01, width + 0.01), (-0.22, 0.3), (top - 0.05, top + 0.18))
    if rng.random() < 0.45:
        high = top + rng.uniform(0.5, 0.9)
        part.block((0.0, width), starting((0.0, depth - 0.3), 0.28), (top, high))
        x = rng.uniform(0.2, 0.6) * width
        part.block((x, x + 2.4), (0.4 * depth, 0.4 * depth + 3.0), (top, top + 2.4))
    else:
        ridge = top + rng.uniform(0.5, 1.0) * 0.5 * depth
        for eave in (-0.35, depth + 0.35):
            part.beam((0.5 * width, eave, top + 0.1), (0.5 * width, 0.5 * depth, ridge), width, 0.2)
        for fraction in (0.2, 0.5, 0.8):
            inset = 0.5 * depth * fraction
            high = top + fraction * (ridge - top)
            part.block((0.05, width - 0.05), (inset, depth - inset), (top - 0.1, high))
    x, y = rng.uniform(0.1, 0.85) * width, rng.uniform(0.55, 0.8) * depth
    part.block((x, x + 0.9), (y, y + 0.5), (top - 0.1, top + rng.uniform(2.0, 4.0)))
