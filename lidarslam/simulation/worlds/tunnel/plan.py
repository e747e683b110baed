"""Where a mine's galleries run: a loop, a gallery that cuts across it, side galleries, alcoves and chambers."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import left_of
from lidarslam.simulation.worlds.paths import lengths_along, points_along

SPACING_M = 0.25
_STEEPEST = 0.08


@dataclass(frozen=True)
class Gallery:
    """A drift through the rock."""

    line: FloatArray  # (N, 3) middle of its floor, every `SPACING_M`; the loop's last point is next to its first
    half_widths: FloatArray  # (N,) from the middle to the wall
    heights: FloatArray  # (N,) of the roof above the floor, in the middle


@dataclass(frozen=True)
class MinePlan:
    """Galleries, and pillars of rock left standing in chambers."""

    galleries: tuple[Gallery, ...]  # the loop first
    pillars: FloatArray  # (P, 3) middle x, y and radius


def draw_mine(rng: np.random.Generator) -> MinePlan:
    """A mine no two seeds share, its loop 155 to 260 m long."""
    loop, pillars = _with_chambers(_draw_loop(rng), rng)
    galleries = [loop, _draw_cut(loop, rng)]
    for _ in range(60):
        if len(galleries) >= 11:
            break
        alcove = len(galleries) >= 6
        branch = _draw_branch(loop, rng, alcove)
        if _keeps_apart(branch, galleries):
            galleries.append(branch)
    return MinePlan(tuple(galleries), pillars)


def loop_lefts(line: FloatArray) -> FloatArray:
    """(N, 2) unit vectors to the left of a closed line (N, 3)."""
    left = left_of(np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0))
    return np.asarray(left / np.linalg.norm(left, axis=1, keepdims=True))


def _draw_loop(rng: np.random.Generator) -> Gallery:
    """A star-shaped loop of random waves, rising and falling gently."""
    angle = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    radius = np.ones_like(angle)
    for k in range(2, 13):
        size = 0.24 / (k - 0.6) if k < 6 else 0.022
        radius += size * rng.uniform(0.4, 1.0) * np.cos(k * angle + rng.uniform(0.0, 2.0 * np.pi))
    xy = np.stack([rng.uniform(1.0, 1.5) * radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    closed = np.concatenate([xy, xy[:1]])
    along = lengths_along(closed)
    length = rng.uniform(155.0, 260.0)
    n = round(length / SPACING_M)
    line = points_along(closed * (length / along[-1]), along * length / along[-1], length / n * np.arange(n, dtype=np.float64))
    z = _waves(rng, n, 3)
    steepest = float(np.abs(np.roll(z, -1) - z).max()) * n / length
    z *= rng.uniform(0.6, 1.0) * _STEEPEST / steepest
    return Gallery(
        np.column_stack([line, z - z[0]]),
        2.25 + 0.5 * np.tanh(_waves(rng, n, 14)),
        3.2 + 0.5 * np.tanh(_waves(rng, n, 9)),
    )


def _waves(rng: np.random.Generator, n: int, most: int) -> FloatArray:
    """(N,) periodic random curve of unit deviation with up to `most` waves."""
    phase = np.arange(n) * (2.0 * np.pi / n)
    orders = range(1, most + 1)
    curve = sum((rng.normal() * np.cos(k * phase + rng.uniform(0.0, 2.0 * np.pi)) for k in orders), np.zeros(n))
    return np.asarray(curve / curve.std())


def _with_chambers(loop: Gallery, rng: np.random.Generator) -> tuple[Gallery, FloatArray]:
    """The loop with one to three places where it widens, and pillars that stand in them."""
    n, widths, heights = len(loop.line), loop.half_widths.copy(), loop.heights.copy()
    left, pillars = loop_lefts(loop.line), []
    for k in rng.choice(8, size=int(rng.integers(1, 4)), replace=False):
        middle = int((k + 0.5) * n / 8)
        away = np.minimum(np.mod(np.arange(n) - middle, n), np.mod(middle - np.arange(n), n)) * SPACING_M
        bump = np.exp(-((away / rng.uniform(3.0, 5.0)) ** 2))
        widths += rng.uniform(1.6, 2.6) * bump
        heights += rng.uniform(0.2, 0.7) * bump
        for side in (-1.0, 1.0):
            if rng.random() < 0.6:
                radius = rng.uniform(0.5, 0.8)
                xy = loop.line[middle, :2] + side * (radius + rng.uniform(1.9, 2.2)) * left[middle]
                pillars.append([*xy, radius])
    return Gallery(loop.line, widths, np.minimum(heights, 4.2)), np.array(pillars).reshape(-1, 3)


def _draw_cut(loop: Gallery, rng: np.random.Generator) -> Gallery:
    """A bowed gallery from one side of the loop to the other."""
    n = len(loop.line)
    start = int(rng.integers(n))
    end = (start + n // 2 + int(rng.integers(-n // 10, n // 10))) % n
    a, b = loop.line[start], loop.line[end]
    across = np.array([a[1] - b[1], b[0] - a[0], 0.0])
    bend = 0.5 * (a + b) + rng.uniform(-0.3, 0.3) * across
    t = np.linspace(0.0, 1.0, 400)[:, None]
    return _gallery((1 - t) ** 2 * a + 2 * t * (1 - t) * bend + t**2 * b, rng, (1.5, 2.1), (2.6, 3.3))


def _draw_branch(loop: Gallery, rng: np.random.Generator, alcove: bool) -> Gallery:
    """A dead end off the loop: a gallery of 8 to 16 m, or an alcove a few metres deep."""
    k, side = int(rng.integers(len(loop.line))), float(rng.choice([-1.0, 1.0]))
    left = loop_lefts(loop.line)[k] * side
    heading = float(np.arctan2(left[1], left[0])) + rng.uniform(-0.5, 0.5)
    length = loop.half_widths[k] + (rng.uniform(1.2, 2.4) if alcove else rng.uniform(8.0, 16.0))
    at = np.arange(0.0, length, SPACING_M)
    headings = heading + rng.uniform(-0.05, 0.05) * at
    xy = loop.line[k, :2] + np.cumsum(np.stack([np.cos(headings), np.sin(headings)], axis=1), axis=0) * SPACING_M
    z = loop.line[k, 2] + (0.0 if alcove else rng.uniform(-_STEEPEST, _STEEPEST)) * np.maximum(at - 2.0, 0.0)
    widths, heights = ((0.8, 1.3), (2.0, 2.6)) if alcove else ((1.4, 2.0), (2.4, 3.2))
    return _gallery(np.column_stack([xy, z]), rng, widths, heights)


def _gallery(
    line: FloatArray, rng: np.random.Generator, widths: tuple[float, float], heights: tuple[float, float]
) -> Gallery:
    """A gallery along a line of any spacing, its width and height varying between limits."""
    ends = lengths_along(line)
    at = np.arange(0.0, ends[-1], SPACING_M)
    knots = np.linspace(0.0, ends[-1], max(2, int(ends[-1] / 4.0)))
    curves = (np.interp(at, knots, rng.uniform(*limits, len(knots))) for limits in (widths, heights))
    return Gallery(points_along(line, ends, at), *curves)


def _keeps_apart(branch: Gallery, others: list[Gallery]) -> bool:
    """Whether the branch, once it has left the loop, leaves rock between itself and all others."""
    outer = branch.line[int(0.5 * len(branch.line)) :]
    for k, other in enumerate(others):
        gaps = np.linalg.norm(outer[:, None, :2] - other.line[None, ::4, :2], axis=2)
        reach = other.half_widths[None, ::4] + branch.half_widths.max() + 1.2
        # The loop is near by where the branch begins.
        near = gaps[-1:] - reach[:, :] if k == 0 else gaps - reach
        if near.min() < (-1.5 if k == 0 and len(branch.line) < 24 else 0.0):
            return False
    return True
