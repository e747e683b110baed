"""Closed lines on the plane: paths through a world, distances from them, and the free space along them."""

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Route
from lidarslam.simulation.worlds.building import Builder, left_of


def loop_length(loop: FloatArray) -> float:
    """Length of the closed polyline (M, D)."""
    return float(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum())


def lengths_along(line: FloatArray) -> FloatArray:
    """(M,) distance from the first point along the open polyline (M, D)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def points_along(line: FloatArray, lengths: FloatArray, wanted: FloatArray) -> FloatArray:
    """Points (N, D) at wanted lengths (N,) of the polyline (M, D), whose vertices are at lengths (M,)."""
    return np.stack([np.interp(wanted, lengths, column) for column in line.T], axis=1)


def resample_loop(loop: FloatArray, spacing_m: float) -> FloatArray:
    """Points (N, D) at equal distances, about `spacing_m`, along the closed polyline (M, D)."""
    closed = np.concatenate([loop, loop[:1]])
    at = lengths_along(closed)
    count = max(3, round(at[-1] / spacing_m))
    return points_along(closed, at, np.arange(count) * (at[-1] / count))


def subdivide_loop(loop: FloatArray, spacing_m: float) -> FloatArray:
    """The closed polyline (M, D) with points (N, D) added, so that none is farther than `spacing_m` from the next."""
    following = np.roll(loop, -1, axis=0)
    counts = np.maximum(1, np.ceil(np.linalg.norm(following - loop, axis=1) / spacing_m).astype(int))
    legs = zip(loop, following, counts, strict=True)
    return np.concatenate([a + (b - a) * (np.arange(count) / count)[:, None] for a, b, count in legs])


def offset_loop(corners: FloatArray, right_m: float) -> FloatArray:
    """The closed polyline (M, 2) moved to the right of its direction; corners must not be hairpins."""
    along = np.roll(corners, -1, axis=0) - corners
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    after = -left_of(along)
    before = np.roll(after, 1, axis=0)
    mitre = (before + after) / (1.0 + (before * after).sum(axis=1, keepdims=True))
    return np.asarray(corners + right_m * mitre)


def turning_angles(vertices: FloatArray) -> FloatArray:
    """(M,) change of heading at each vertex (M, >=2) of a closed polyline, in [-pi, pi]; counter-clockwise positive."""
    xy = vertices[:, :2]
    arriving, leaving = xy - np.roll(xy, 1, axis=0), np.roll(xy, -1, axis=0) - xy
    cross = arriving[:, 0] * leaving[:, 1] - arriving[:, 1] * leaving[:, 0]
    return np.asarray(np.arctan2(cross, (arriving * leaving).sum(axis=1)))


def round_corners(corners: FloatArray, radii: FloatArray, step_m: float) -> FloatArray:
    """The closed polyline (M, 2) with arcs of `radii` (M,) for corners, in points (N, 2) `step_m` apart on the arcs."""
    pieces = []
    befores, afters = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
    for before, corner, after, radius in zip(befores, corners, afters, radii, strict=True):
        into = (corner - before) / np.linalg.norm(corner - before)
        out = (after - corner) / np.linalg.norm(after - corner)
        turn = np.arctan2(into[0] * out[1] - into[1] * out[0], into @ out)
        start = corner - radius * np.tan(0.5 * abs(turn)) * into
        angles = abs(turn) * np.linspace(0.0, 1.0, 1 + max(1, int(np.ceil(radius * abs(turn) / step_m))))
        sideways = np.sign(turn) * (1.0 - np.cos(angles))
        pieces.append(start + radius * (np.sin(angles)[:, None] * into + sideways[:, None] * left_of(into)))
    return np.concatenate(pieces)


def winding_loop(
    rng: np.random.Generator, length_m: float, harmonics: int, wobble: float, min_radius_m: float
) -> FloatArray:
    """A smooth closed line (N, 2) around the origin, in either sense, points half a metre apart.

    Its distance from the origin sways with `harmonics` waves a turn at most; lines with bends tighter than
    `min_radius_m` are drawn again, with less and less sway.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 181)[:-1]
    wave = np.arange(2, harmonics + 1)
    while True:
        size, phase = rng.uniform(0.4, 1.0, len(wave)) / wave, rng.uniform(0.0, 2.0 * np.pi, len(wave))
        radius = 1.0 + wobble * (size * np.cos(angle[:, None] * wave + phase)).sum(axis=1)
        loop = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        loop *= length_m / loop_length(loop)
        closed = np.concatenate([loop, loop[:1]])
        spline = CubicSpline(np.append(angle, 2.0 * np.pi), closed, bc_type="periodic")
        speed, bend = spline(angle, 1), spline(angle, 2)
        curvature = np.abs(speed[:, 0] * bend[:, 1] - speed[:, 1] * bend[:, 0]) / np.linalg.norm(speed, axis=1) ** 3
        if curvature.max() * min_radius_m <= 1.0 and radius.min() > 0.3:
            fine = spline(np.linspace(0.0, 2.0 * np.pi, 4001)[:-1])
            return resample_loop(fine, 0.5)[:: rng.choice([-1, 1])]
        wobble *= 0.97


def distance_to_loop(xy: FloatArray, loop: FloatArray, farthest_m: float = np.inf) -> FloatArray:
    """Distance (...) of points (..., 2) from the closed polyline (M, 2), to 0.1 m from a decimetre on.

    Distances beyond `farthest_m` are given as `farthest_m`, without a search.
    """
    distance, _ = cKDTree(resample_loop(loop, 0.2)).query(xy, distance_upper_bound=farthest_m)
    return np.minimum(distance, farthest_m)


def grid_nodes(low: FloatArray, high: FloatArray, cell_m: float) -> FloatArray:
    """Nodes (X, Y, 2) of a regular grid from the corner low to the corner high (2,) or a little beyond."""
    counts = np.ceil((high - low) / cell_m).astype(int) + 1
    return np.asarray(low + cell_m * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1))


def grid_around(points: FloatArray, margin_m: float, cell_m: float) -> tuple[FloatArray, FloatArray]:
    """The lowest node (2,) of a grid that reaches that far around points (N, 2), at whole metres, and all (X, Y, 2)."""
    low = np.floor(points.min(axis=0) - margin_m)
    return low, grid_nodes(low, points.max(axis=0) + margin_m, cell_m)


def on_ground(xy: FloatArray, ground: HeightField) -> FloatArray:
    """Points (N, 3) on the ground at (N, 2)."""
    return np.column_stack([xy, ground.height_at(xy)])


def prune(part: Builder, route: Route, margin_m: float = 0.1) -> Builder:
    """The part without the leaves and branches that reach into the route's free space.

    A box counts as large as the upright round block around it, so this is for small things.
    """
    boxes, cylinders = part.solids
    reach = (np.abs(boxes.R_world_box) @ boxes.half_sizes[:, :, None])[:, :, 0]
    floor = _highest_within(boxes.centres[:, :2], np.hypot(reach[:, 0], reach[:, 1]) + margin_m, route)
    keep_boxes = boxes.centres[:, 2] - reach[:, 2] > floor + route.free_height_m + margin_m

    fraction = np.linspace(0.0, 1.0, 13)[:, None]
    axis = (cylinders.starts[:, None, :] + fraction * (cylinders.ends - cylinders.starts)[:, None, :]).reshape(-1, 3)
    radii = np.repeat(cylinders.radii, len(fraction))
    # Between two samples of its axis a cylinder comes a little nearer than at them.
    floor = _highest_within(axis[:, :2], radii + 2.0 * margin_m, route)
    above = axis[:, 2] - radii > floor + route.free_height_m + 2.0 * margin_m
    return part.selected(keep_boxes, np.asarray(above.reshape(-1, len(fraction)).all(axis=1)))


def _highest_within(xy: FloatArray, margins_m: FloatArray, route: Route) -> FloatArray:
    """z (N,) of the highest point of the route whose free side comes within the margins (N,) of (N, 2), or -inf."""
    path = subdivide_loop(route.waypoints, 0.2)
    near = cKDTree(path[:, :2]).query_ball_point(xy, route.free_side_m + margins_m)
    return np.array([path[indices, 2].max(initial=-np.inf) for indices in near])


_SPACING_M = 0.1


@dataclass
class Clearance:
    """Upright blocks of space that are taken, besides the free space along a route."""

    route: Route
    margin_m: float = 0.08  # around the route's free space
    _path: FloatArray = field(init=False)
    _lows: FloatArray = field(init=False)
    _highs: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self._path = subdivide_loop(self.route.waypoints, _SPACING_M)
        self._lows, self._highs = np.empty((0, 3)), np.empty((0, 3))

    def on_route(self, low: FloatArray, high: FloatArray) -> bool:
        """Whether the block between corners low and high (3,) reaches into the route's free space."""
        reach = self.route.free_side_m + self.margin_m
        apart = np.maximum(np.maximum(low[:2] - self._path[:, :2], self._path[:, :2] - high[:2]), 0.0)
        beside = np.hypot(apart[:, 0], apart[:, 1]) < reach
        level = (self._path[:, 2] < high[2]) & (self._path[:, 2] + self.route.free_height_m + self.margin_m > low[2])
        return bool((beside & level).any())

    def claim(self, low: FloatArray, high: FloatArray, gap_m: float = 0.0) -> bool:
        """Take the block if it keeps off the route, and `gap_m` from all blocks that are taken; whether it did."""
        gap = np.array([gap_m, gap_m, 0.0])
        if self.on_route(low, high) or ((low < self._highs + gap) & (self._lows < high + gap)).all(axis=1).any():
            return False
        self.take(low, high)
        return True

    def take(self, low: FloatArray, high: FloatArray) -> None:
        """Take the block between corners low and high (3,) without a check."""
        self._lows, self._highs = np.vstack([self._lows, low]), np.vstack([self._highs, high])
