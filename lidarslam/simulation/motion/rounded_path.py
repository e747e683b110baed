"""A polyline with its corners rounded off, smooth to the third derivative."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarslam.core.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class RoundedPath:
    """An open polyline, averaged over a window that slides along it.

    With u the length along the polyline and k the window (15/16h)(1 - (x/h)^2)^2 of half width h, the path is the
    polyline convolved with k: straight where the polyline is straight within h, its second derivative at a corner the
    change of direction times k. Each corner has its own h, so that there are closed forms throughout.
    """

    vertices: FloatArray  # (M, D) of the polyline
    half_widths: FloatArray  # (M,) of the window at each vertex; the ends are not rounded

    @cached_property
    def lengths(self) -> FloatArray:
        """(M,) length along the polyline at each vertex; the path's parameter u."""
        steps = np.linalg.norm(np.diff(self.vertices[:, :2], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def _directions(self) -> FloatArray:
        return np.diff(self.vertices, axis=0) / np.diff(self.lengths)[:, None]

    def at(self, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points (N, D) and their first and second derivatives by u, at increasing u (N,)."""
        leg = np.clip(np.searchsorted(self.lengths, u, side="right") - 1, 0, len(self._directions) - 1)
        first = self._directions[leg]
        points = self.vertices[leg] + (u - self.lengths[leg])[:, None] * first
        second = np.zeros_like(points)
        for corner in range(1, len(self.vertices) - 1):
            h = self.half_widths[corner]
            near = slice(*np.searchsorted(u, [self.lengths[corner] - h, self.lengths[corner] + h]))
            x = u[near] - self.lengths[corner]
            ramp, step, bump = _window(x / h)
            change = self._directions[corner] - self._directions[corner - 1]
            points[near] += np.multiply.outer(h * ramp - np.maximum(x, 0.0), change)
            first[near] += np.multiply.outer(step - (x >= 0.0), change)
            second[near] += np.multiply.outer(bump / h, change)
        return points, first, second


def _window(z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The window of half width 1 and its first two integrals, the last first, for z in [-1, 1]."""
    z2 = z * z
    bump = 15.0 / 16.0 * (1.0 - z2) ** 2
    step = 0.5 + 15.0 / 16.0 * z * (1.0 - z2 * (2.0 / 3.0 - z2 / 5.0))
    ramp = 5.0 / 32.0 + 0.5 * z + 15.0 / 16.0 * z2 * (0.5 - z2 * (1.0 / 6.0 - z2 / 30.0))
    return ramp, step, bump


def turning_angles(vertices: FloatArray) -> FloatArray:
    """(M,) change of heading at each vertex (M, >=2) of a closed polyline, in [-pi, pi]; counter-clockwise positive."""
    xy = vertices[:, :2]
    arriving, leaving = xy - np.roll(xy, 1, axis=0), np.roll(xy, -1, axis=0) - xy
    cross = arriving[:, 0] * leaving[:, 1] - arriving[:, 1] * leaving[:, 0]
    return np.asarray(np.arctan2(cross, (arriving * leaving).sum(axis=1)))


def corner_windows(vertices: FloatArray, corner_m: float, cut_m: float) -> FloatArray:
    """Half widths (M,) for an open polyline (M, >=2).

    At a corner that turns by a, the path stays 5/16 h sin(a/2) inside it, at most `cut_m`, and the window ends at the
    neighbouring vertices: a chain of short legs becomes one even bend, a lone corner spreads over `corner_m` at most.
    """
    legs = np.linalg.norm(np.diff(vertices[:, :2], axis=0), axis=1)
    angles = turning_angles(vertices)[1:-1]
    inside = cut_m / np.maximum(5.0 / 16.0 * np.sin(0.5 * np.abs(angles)), 1e-6)
    h = np.minimum(np.minimum(legs[:-1], legs[1:]), np.minimum(inside, corner_m))
    return np.concatenate([[0.0], h, [0.0]])


def straightened(vertices: FloatArray, tolerance_m: float) -> FloatArray:
    """The fewest vertices of a closed polyline (M, 3) that keep it within `tolerance_m` (Douglas and Peucker)."""
    closed = np.concatenate([vertices, vertices[:1]])
    farthest = int(np.linalg.norm(vertices - vertices[0], axis=1).argmax())
    keep = np.zeros(len(closed), dtype=bool)
    keep[[0, farthest]] = True
    pending = [(0, farthest), (farthest, len(closed) - 1)]
    while pending:
        first, last = pending.pop()
        if last - first < 2:
            continue
        chord = closed[last] - closed[first]
        offsets = closed[first + 1 : last] - closed[first]
        along = np.clip(offsets @ chord / max(float(chord @ chord), 1e-12), 0.0, 1.0)
        distance = np.linalg.norm(offsets - along[:, None] * chord, axis=1)
        worst = int(distance.argmax())
        if distance[worst] > tolerance_m:
            middle = first + 1 + worst
            keep[middle] = True
            pending += [(first, middle), (middle, last)]
    return np.asarray(vertices[keep[:-1]])
