"""Putting primitives together: the brushes that every world is painted with."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Boxes, Cylinders

UP = np.array([0.0, 0.0, 1.0])


def rotation_z(yaw: float) -> FloatArray:
    """(3, 3) turn about the vertical, radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_along(step: FloatArray) -> FloatArray:
    """(3, 3) with x along the step (3,), y level, z upwards; for an upright step, y along the world's."""
    x = step / np.linalg.norm(step)
    across = np.array([-x[1], x[0], 0.0])
    length = float(np.linalg.norm(across))
    y = across / length if length > 1e-9 else np.array([0.0, 1.0, 0.0])
    return np.stack([x, y, np.cross(x, y)], axis=1)


@dataclass
class Builder:
    """Collects boxes and cylinders one by one; `boxes` and `cylinders` hand them out as arrays."""

    _boxes: list[tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=list)
    _cylinders: list[tuple[FloatArray, FloatArray, float]] = field(default_factory=list)

    def box(
        self,
        centre: tuple[float, float, float] | FloatArray,
        size: tuple[float, float, float] | FloatArray,
        yaw: float = 0.0,
        R: FloatArray | None = None,
    ) -> None:
        """A box by its centre and full size, turned by `yaw` about the vertical, or by any rotation `R`."""
        rotation = rotation_z(yaw) if R is None else R
        self._boxes.append((np.asarray(centre, float), 0.5 * np.asarray(size, float), rotation))

    def wall(self, a_xy: FloatArray, b_xy: FloatArray, z: tuple[float, float], thickness: float) -> None:
        """A wall with its middle line from a to b (2,), from height z[0] to z[1]."""
        step = np.asarray(b_xy, float) - np.asarray(a_xy, float)
        middle = np.asarray(a_xy, float) + 0.5 * step
        centre = np.array([middle[0], middle[1], 0.5 * (z[0] + z[1])])
        size = np.array([float(np.linalg.norm(step)), thickness, z[1] - z[0]])
        self.box(centre, size, yaw=float(np.arctan2(step[1], step[0])))

    def cylinder(self, start: FloatArray, end: FloatArray, radius: float) -> None:
        """A cylinder between the centres of its ends (3,)."""
        self._cylinders.append((np.asarray(start, float), np.asarray(end, float), radius))

    def beam(self, start: FloatArray, end: FloatArray, width: float, height: float) -> None:
        """A straight beam between the centres of its ends (3,), its upper face turned up as far as its slope allows."""
        step = np.asarray(end, float) - np.asarray(start, float)
        middle = np.asarray(start, float) + 0.5 * step
        self.box(middle, np.array([np.linalg.norm(step), width, height]), R=rotation_along(step))

    def pole(self, xy: FloatArray, z: tuple[float, float], radius: float) -> None:
        """An upright cylinder at (2,), from height z[0] to z[1]."""
        self.cylinder(np.array([xy[0], xy[1], z[0]]), np.array([xy[0], xy[1], z[1]]), radius)

    def block(self, low: tuple[float, float, float], high: tuple[float, float, float]) -> None:
        """A box along the axes, between two opposite corners."""
        a, b = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)
        self.box(0.5 * (a + b), b - a)

    def place(self, part: "Builder", T_world_part: FloatArray) -> None:
        """Add everything of `part`, which was drawn in its own frame."""
        R, t = T_world_part[:3, :3], T_world_part[:3, 3]
        self._boxes += [(R @ centre + t, half_size, R @ R_part) for centre, half_size, R_part in part._boxes]
        self._cylinders += [(R @ start + t, R @ end + t, radius) for start, end, radius in part._cylinders]

    def selected(self, boxes: NDArray[np.bool_], cylinders: NDArray[np.bool_]) -> "Builder":
        """Those boxes and cylinders for which the masks, one entry for each, are true."""
        return Builder(
            [one for one, keep in zip(self._boxes, boxes, strict=True) if keep],
            [one for one, keep in zip(self._cylinders, cylinders, strict=True) if keep],
        )

    @property
    def boxes(self) -> Boxes:
        """All boxes so far."""
        if not self._boxes:
            return Boxes.empty()
        centres, half_sizes, rotations = zip(*self._boxes, strict=True)
        return Boxes(np.stack(centres), np.stack(half_sizes), np.stack(rotations))

    @property
    def cylinders(self) -> Cylinders:
        """All cylinders so far."""
        if not self._cylinders:
            return Cylinders.empty()
        starts, ends, radii = zip(*self._cylinders, strict=True)
        return Cylinders(np.stack(starts), np.stack(ends), np.array(radii, dtype=np.float64))


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], scale: float) -> FloatArray:
    """A smooth random surface of the given grid shape, zero mean, unit deviation, bumps about `scale` cells wide."""
    from scipy.ndimage import gaussian_filter

    rough = gaussian_filter(rng.standard_normal(shape), scale, mode="reflect")
    rough -= rough.mean()
    return np.asarray(rough / max(float(rough.std()), 1e-12))
