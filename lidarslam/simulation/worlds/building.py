"""Walls with closed windows and open doorways."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Boxes, Cylinders

UP = np.array([0.0, 0.0, 1.0])
HAIR_M = 0.002  # by which neighbouring faces are offset from one plane

Limits = tuple[float, float] | Sequence[float]  # lower and upper bound along an axis
Vector = Sequence[float] | FloatArray


def rotation_z(yaw: float) -> FloatArray:
    """(3, 3) rotation about the vertical, radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_along(step: FloatArray) -> FloatArray:
    """(3, 3) with x along the step (3,), y level, z upwards; for an upright step, y along the world's."""
    x = step / np.linalg.norm(step)
    across = np.array([-x[1], x[0], 0.0])
    length = float(np.linalg.norm(across))
    y = across / length if length > 1e-9 else np.array([0.0, 1.0, 0.0])
    return np.stack([x, y, np.cross(x, y)], axis=1)


def heading(direction: FloatArray) -> float:
    """Yaw of a direction (2,)."""
    return float(np.arctan2(direction[1], direction[0]))


def left_of(directions: FloatArray) -> FloatArray:
    """Directions (..., 2) turned to the left by 90 degrees."""
    return np.stack([-directions[..., 1], directions[..., 0]], axis=-1)


@dataclass
class Builder:
    """Collects boxes and cylinders one by one; `solids` hands them out as arrays."""

    _boxes: list[tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=list)
    _cylinders: list[tuple[FloatArray, FloatArray, float]] = field(default_factory=list)

    def box(self, centre: Vector, size: Vector, yaw: float = 0.0, R: FloatArray | None = None) -> None:
        """A box by its centre and full size, turned by `yaw` about the vertical, or by any rotation `R`."""
        rotation = rotation_z(yaw) if R is None else R
        self._boxes.append((np.asarray(centre, float), 0.5 * np.asarray(size, float), rotation))

    def wall(self, a_xy: FloatArray, b_xy: FloatArray, z: Limits, thickness: float) -> None:
        """A wall with its middle line from a to b (2,), from height z[0] to z[1]."""
        step = b_xy - a_xy
        centre = np.append(a_xy + 0.5 * step, 0.5 * (z[0] + z[1]))
        self.box(centre, (float(np.linalg.norm(step)), thickness, z[1] - z[0]), yaw=heading(step))

    def cylinder(self, start: Vector, end: Vector, radius: float) -> None:
        """A cylinder between the centres of its ends (3,)."""
        self._cylinders.append((np.asarray(start, float), np.asarray(end, float), radius))

    def beam(self, start: Vector, end: Vector, width: float, height: float) -> None:
        """A straight beam between the centres of its ends (3,), its upper face turned up as far as its slope allows."""
        step = np.asarray(end, float) - np.asarray(start, float)
        middle = np.asarray(start, float) + 0.5 * step
        self.box(middle, (float(np.linalg.norm(step)), width, height), R=rotation_along(step))

    def pole(self, xy: Vector, z: Limits, radius: float) -> None:
        """An upright cylinder at (2,), from height z[0] to z[1]."""
        self.cylinder((xy[0], xy[1], z[0]), (xy[0], xy[1], z[1]), radius)

    def block(self, low: Vector, high: Vector) -> None:
        """A box along the axes, between two opposite corners."""
        a, b = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)
        self.box(0.5 * (a + b), b - a)

    def place(self, part: "Builder", T_world_part: FloatArray) -> None:
        """Add all primitives of `part`, which was drawn in its own frame."""
        R, t = T_world_part[:3, :3], T_world_part[:3, 3]
        self._boxes += [(R @ centre + t, half_size, R @ R_part) for centre, half_size, R_part in part._boxes]
        self._cylinders += [(R @ start + t, R @ end + t, radius) for start, end, radius in part._cylinders]

    def selected(self, boxes: NDArray[np.bool_], cylinders: NDArray[np.bool_]) -> "Builder":
        """The boxes and cylinders of two masks."""
        return Builder(
            [one for one, keep in zip(self._boxes, boxes, strict=True) if keep],
            [one for one, keep in zip(self._cylinders, cylinders, strict=True) if keep],
        )

    @property
    def boxes(self) -> Boxes:
        """All boxes so far."""
        return Boxes(*map(np.stack, zip(*self._boxes, strict=True)))

    @property
    def cylinders(self) -> Cylinders:
        """All cylinders so far."""
        return Cylinders(*map(np.stack, zip(*self._cylinders, strict=True)))

    @property
    def solids(self) -> tuple[Boxes, Cylinders]:
        """All primitives so far."""
        return self.boxes, self.cylinders


@dataclass(frozen=True)
class Spot:
    """A frame to draw in, turned about the vertical; at a wall x runs along it and y away from it."""

    builder: Builder
    origin: FloatArray  # (3,) in the world
    yaw: float

    def point(self, x: float, y: float, z: float) -> FloatArray:
        """A point (3,) of the spot, in the world."""
        return np.asarray(self.origin + rotation_z(self.yaw) @ np.array([x, y, z]))

    def shifted(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> "Spot":
        """A spot within this one."""
        return Spot(self.builder, self.point(x, y, z), self.yaw + yaw)

    def box(self, x: Limits, y: Limits, z: Limits) -> None:
        """A box between limits on the spot's axes, x and y in any order."""
        (x0, x1), (y0, y1) = sorted(x), sorted(y)
        centre = self.point(0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.5 * (z[0] + z[1]))
        self.builder.box(centre, (x1 - x0, y1 - y0, z[1] - z[0]), yaw=self.yaw)

    def rod(self, start: Vector, end: Vector, radius: float) -> None:
        """A cylinder between two points of the spot."""
        self.builder.cylinder(self.point(*start), self.point(*end), radius)

    def pillar(self, x: float, y: float, z: Limits, radius: float) -> None:
        """An upright cylinder at x and y."""
        self.rod((x, y, z[0]), (x, y, z[1]), radius)

    def bounds(self, x: Limits, y: Limits, z: Limits) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner (3,) in the world of a block, for a spot along the axes."""
        a, b = self.point(x[0], y[0], z[0]), self.point(x[1], y[1], z[1])
        return np.minimum(a, b), np.maximum(a, b)

    def pierced_wall(self, x: Limits, y: Limits, height: float, openings: "list[Opening]") -> None:
        """A wall with openings: whole between them, and closed below and above each."""
        at = x[0]
        for hole in sorted(openings, key=lambda o: o.x):
            self.box((at, hole.x[0]), y, (0.0, height))
            if hole.z[0] > 0.0:
                self.box(hole.x, y, (0.0, hole.z[0]))
            self.box(hole.x, y, (hole.z[1], height))
            at = hole.x[1]
        self.box((at, x[1]), y, (0.0, height))


@dataclass(frozen=True)
class Opening:
    """An opening of a wall for a door, a window or a gate: limits along the wall and in height."""

    x: tuple[float, float]
    z: tuple[float, float]


def smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], scale: float) -> FloatArray:
    """A smooth random surface of the given grid shape, zero mean, unit deviation, bumps about `scale` cells wide."""
    from scipy.ndimage import gaussian_filter

    rough = gaussian_filter(rng.standard_normal(shape), scale, mode="reflect")
    rough -= rough.mean()
    return np.asarray(rough / max(float(rough.std()), 1e-12))


OUTER_WALL_M = 0.2
_PANE_M, _BAR_M = 0.05, 0.03


def glazed_wall(
    spot: Spot, x: Limits, height: float, windows: list[Opening], doorways: tuple[Opening, ...] = ()
) -> None:
    """A wall whose inner face is at y = 0 of the spot; windows are recesses closed by a pane with an upright bar."""
    spot.pierced_wall(x, (-OUTER_WALL_M, 0.0), height, [*windows, *doorways])
    for window in windows:
        middle = 0.5 * (window.x[0] + window.x[1])
        spot.box(window.x, (-OUTER_WALL_M, -OUTER_WALL_M + _PANE_M), window.z)
        spot.box((middle - _BAR_M, middle + _BAR_M), (-OUTER_WALL_M, -OUTER_WALL_M + 2.0 * _PANE_M), window.z)
