"""Solids drawn in frames; rooms, and walls with closed windows and open doorways."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from lidarslam.core.geometry import FloatArray, rotation_z
from lidarslam.simulation.world import Boxes, Cylinders

UP = np.array([0.0, 0.0, 1.0])
HAIR_M = 0.002  # by which neighbouring faces are offset from one plane

Limits = tuple[float, float] | Sequence[float]  # lower and upper bound along an axis
Vector = Sequence[float] | FloatArray
Spans = Limits | Sequence[Limits] | FloatArray  # limits or several (N, 2)


def around(middles: Vector, half: float) -> FloatArray:
    """Limits (N, 2) that far to either side of each middle (N,)."""
    return np.asarray(np.add.outer(np.asarray(middles, float), [-half, half]))


def starting(places: Vector, wide: float) -> FloatArray:
    """Limits (N, 2) of that width, beginning at each place (N,)."""
    return np.asarray(np.add.outer(np.asarray(places, float), [0.0, wide]))


def row(start: float, stop: float, count: int, gap: float) -> FloatArray:
    """Limits (N, 2) side by side, with that gap at either side of each."""
    edges = np.linspace(start, stop, count + 1)
    return np.stack([edges[:-1] + gap, edges[1:] - gap], axis=1)


def heading(direction: FloatArray) -> float:
    """Yaw of a direction (2,)."""
    return float(np.arctan2(direction[1], direction[0]))


def left_of(directions: FloatArray) -> FloatArray:
    """Directions (..., 2) turned to the left by 90 degrees."""
    return np.stack([-directions[..., 1], directions[..., 0]], axis=-1)


class Opening(NamedTuple):
    """An opening of a wall for a door, a window or a gate: limits along the wall and in height."""

    x: tuple[float, float]
    z: tuple[float, float]


@dataclass(frozen=True)
class Builder:
    """Collects boxes and cylinders, drawn in a frame; `shifted` frames add to the same collection.

    At a wall, a frame's x runs along it and y away from it.
    """

    origin: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,) in the world
    yaw: float = 0.0
    _boxes: list[tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=list)
    _cylinders: list[tuple[FloatArray, FloatArray, float]] = field(default_factory=list)

    @cached_property
    def _R(self) -> FloatArray:
        return rotation_z(self.yaw)

    def point(self, x: float, y: float, z: float = 0.0) -> FloatArray:
        """A point (3,) of the frame, in the world."""
        return np.asarray(self.origin + self._R @ np.array([x, y, z]))

    def shifted(self, *xyz: float, yaw: float = 0.0) -> "Builder":
        """A frame at a point of this one, z may be left out, turned about the vertical."""
        return replace(self, origin=self.point(*xyz), yaw=self.yaw + yaw)

    def bounds(self, x: Limits, y: Limits, z: Limits) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner (3,) in the world of a block, for a frame along the axes."""
        a, b = self.point(x[0], y[0], z[0]), self.point(x[1], y[1], z[1])
        return np.minimum(a, b), np.maximum(a, b)

    def box(self, centre: Vector, size: Vector, yaw: float = 0.0, R: FloatArray | None = None) -> None:
        """A box by its centre and full size, turned by `yaw` about the vertical, or by any rotation `R`."""
        turn = rotation_z(self.yaw + yaw) if R is None else self._R @ R
        self._boxes.append((self.point(*centre), 0.5 * np.asarray(size, float), turn))

    def block(self, x: Spans, y: Spans, z: Spans) -> None:
        """Boxes along the axes between limits in any order, one for each combination of the axes' limits, x slowest."""
        for limits in product(*(np.array(spans, dtype=np.float64).reshape(-1, 2) for spans in (x, y, z))):
            low, high = np.array(limits).T
            self.box(0.5 * (low + high), np.abs(high - low))

    def blocks(self, *rows: Sequence[float]) -> None:
        """Boxes along the axes, each by its limits x x y y z z; five numbers are x x y z z, y from -y to y, and four
        are x y z z.
        """
        for row in rows:
            x = (-row[0], row[0]) if len(row) == 4 else row[:2]
            y = (-row[-3], row[-3]) if len(row) < 6 else row[2:4]
            self.block(x, y, row[-2:])

    def wall(self, a_xy: FloatArray, b_xy: FloatArray, z: Limits, thickness: float) -> None:
        """A wall with its middle line from a to b (2,), from height z[0] to z[1]."""
        step = b_xy - a_xy
        centre = np.append(a_xy + 0.5 * step, 0.5 * (z[0] + z[1]))
        self.box(centre, (float(np.linalg.norm(step)), thickness, z[1] - z[0]), yaw=heading(step))

    def beam(self, start: Vector, end: Vector, width: float, height: float) -> None:
        """A straight beam between the centres of its ends (3,), its upper face turned up as far as its slope allows."""
        step = np.asarray(end, float) - np.asarray(start, float)
        length = float(np.linalg.norm(step))
        x = step / length
        across = np.array([-x[1], x[0], 0.0])
        level = float(np.linalg.norm(across))
        y = across / level if level > 1e-9 else np.array([0.0, 1.0, 0.0])
        R = np.stack([x, y, np.cross(x, y)], axis=1)
        self.box(np.asarray(start, float) + 0.5 * step, (length, width, height), R=R)

    def cylinder(self, start: Vector, end: Vector, radius: float) -> None:
        """A cylinder between the centres of its ends (3,)."""
        self._cylinders.append((self.point(*start), self.point(*end), radius))

    def pole(self, xy: Vector, z: Limits, radius: float) -> None:
        """An upright cylinder at (2,), from height z[0] to z[1]."""
        self.cylinder((*xy, z[0]), (*xy, z[1]), radius)

    def poles(self, *rows: tuple[float, float, float, float, float]) -> None:
        """Upright cylinders, each by x, y, its lower and its upper end, and its radius."""
        for x, y, low, high, radius in rows:
            self.pole((x, y), (low, high), radius)

    def pierced_wall(self, x: Limits, y: Limits, height: float, openings: Iterable[Opening]) -> None:
        """A wall with openings: whole between them, and closed below and above each."""
        at = x[0]
        for hole in sorted(openings):
            self.block((at, hole.x[0]), y, (0.0, height))
            if hole.z[0] > 0.0:
                self.block(hole.x, y, (0.0, hole.z[0]))
            self.block(hole.x, y, (hole.z[1], height))
            at = hole.x[1]
        self.block((at, x[1]), y, (0.0, height))

    def glazed_wall(self, x: Limits, height: float, windows: list[Opening], *doorways: Opening) -> None:
        """A wall whose inner face is at y = 0; windows are recesses closed by a pane with an upright bar."""
        self.pierced_wall(x, (-OUTER_WALL_M, 0.0), height, [*windows, *doorways])
        for window in windows:
            middle = 0.5 * (window.x[0] + window.x[1])
            self.block(window.x, (-OUTER_WALL_M, -OUTER_WALL_M + _PANE_M), window.z)
            bar = (middle - _BAR_M, middle + _BAR_M)
            self.block(bar, (-OUTER_WALL_M, -OUTER_WALL_M + 2.0 * _PANE_M), window.z)

    def place(self, part: "Builder", T_frame_part: FloatArray) -> None:
        """Add all primitives of `part`, which was drawn in its own frame."""
        R, t = self._R @ T_frame_part[:3, :3], self.point(*T_frame_part[:3, 3])
        self._boxes.extend((R @ centre + t, half_size, R @ R_part) for centre, half_size, R_part in part._boxes)
        self._cylinders.extend((R @ start + t, R @ end + t, radius) for start, end, radius in part._cylinders)

    def selected(self, boxes: NDArray[np.bool_], cylinders: NDArray[np.bool_]) -> "Builder":
        """The boxes and cylinders of two masks."""
        return Builder(
            _boxes=[one for one, keep in zip(self._boxes, boxes, strict=True) if keep],
            _cylinders=[one for one, keep in zip(self._cylinders, cylinders, strict=True) if keep],
        )

    @property
    def boxes(self) -> Boxes:
        """All boxes so far."""
        return Boxes(*map(np.stack, zip(*self._boxes, strict=True)))

    @property
    def solids(self) -> tuple[Boxes, Cylinders]:
        """All primitives so far."""
        return self.boxes, Cylinders(*map(np.stack, zip(*self._cylinders, strict=True)))


OUTER_WALL_M = 0.2
_PANE_M, _BAR_M = 0.05, 0.03


class Room(NamedTuple):
    """A rectangular room between the middle lines of its walls, (2,) corners low and high."""

    low: FloatArray
    high: FloatArray

    def at_wall(self, side: int, builder: Builder) -> tuple[Builder, float]:
        """The frame at the start of one of the four walls, counter-clockwise from the nearest, and its length."""
        corner = np.where([side in (1, 2), side in (2, 3)], self.high, self.low)
        return builder.shifted(*corner, yaw=0.5 * np.pi * side), float((self.high - self.low)[side % 2])


def smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], scale: float) -> FloatArray:
    """A smooth random surface of the given grid shape, zero mean, unit deviation, bumps about `scale` cells wide."""
    rough = gaussian_filter(rng.standard_normal(shape), scale, mode="reflect")
    rough -= rough.mean()
    return np.asarray(rough / max(float(rough.std()), 1e-12))


def relief(rng: np.random.Generator, shape: tuple[int, ...], *waves: tuple[float, float]) -> FloatArray:
    """The sum of smooth random surfaces, each by its deviation and its scale in cells."""
    return np.asarray(np.sum([size * smooth_noise(rng, shape, scale) for size, scale in waves], axis=0))
