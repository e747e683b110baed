"""What stands along both sides of a given path: rows of houses, parked cars, lamp posts, trees, signs."""

from dataclasses import dataclass, field

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField
from lidarslam.simulation.worlds import furnishing
from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.furnishing import on_slope, upright
from lidarslam.simulation.worlds.open_country import plants
from lidarslam.simulation.worlds.street.course import Course, Land, rectangle
from lidarslam.simulation.worlds.street.houses import house
from lidarslam.simulation.worlds.street.plain_house import plain_house

HALF_WIDTH_M = 5.0
FREE_SIDE_M = 2.5
_PAVEMENT_M = 3.8
# Houses' fronts are straight where the road bends, and may come this much closer.
_CLOSER_M = 1.0
_CAR_M = (5.4, 2.0)
# About how many of each are made, however long the street is.
_MOST_DETAILED_HOUSES, _MOST_CARS, _MOST_PLANTS = 140, 400, 250


@dataclass
class Rows:
    """Puts things beside a course, none on another, none near any part of the course.

    Attributes:
        rng: of what is drawn.
        course: the middle of the road.
        ground: what everything stands on.
        land: what is taken.
    """

    rng: np.random.Generator
    course: Course
    ground: HeightField
    land: Land = field(default_factory=Land)

    def build(self, solid: Builder) -> None:
        """Add everything; houses first, they need most room."""
        loose = Builder()
        for side in self.course.sides():
            self._houses(solid, loose, side)
        for side in self.course.sides():
            self._cars(solid, side)
            self._pavement(loose, side)
        solid.place(self._clear(loose), np.eye(4))

    def _share(self, most: int, spacing_m: float) -> float:
        """Which share of the things that would fit both sides, so far apart, are that many."""
        return min(1.0, most * spacing_m / (2.0 * self.course.length_m))

    def _houses(self, solid: Builder, loose: Builder, side: Course) -> None:
        detailed, at = self._share(_MOST_DETAILED_HOUSES, 11.0), 0.0
        while at < side.length_m:
            width, depth = self.rng.uniform(7.5, 15.0), self.rng.uniform(8.0, 11.0)
            lot = self._lot(side, at, width, depth) or self._lot(side, at, 6.5, depth)
            if lot is None:
                at += 2.0
                continue
            origin, along, width, used = lot
            at += used
            if self.rng.random() < 0.12:  # a garden with a wall or a hedge before it
                self._garden(solid, loose, origin, along, width)
                continue
            front = origin + np.outer(np.linspace(0.0, width, 5), along)
            pose = upright(self.ground, origin, float(np.arctan2(along[1], along[0])))
            pose[2, 3] = self.ground.height_at(front).mean()
            is_detailed = self.rng.random() < detailed
            part = house(self.rng, width, depth, (True, True)) if is_detailed else plain_house(self.rng, width, depth)
            solid.place(part, pose)

    def _lot(
        self, side: Course, at: float, width: float, depth: float
    ) -> tuple[FloatArray, FloatArray, float, float] | None:
        """Origin, direction and width of a free lot, and the length of road that it takes; farther back if need be."""
        front = HALF_WIDTH_M + _PAVEMENT_M
        for setback in (0.0, 1.5, 3.5):
            start, end = side.beside(at, front + setback), side.beside(at + width, front + setback)
            wide = float(np.linalg.norm(end - start))
            if at + width > side.length_m or not 5.0 < wide < 20.0:
                return None
            along = (end - start) / wide
            footprint = rectangle(start, along, wide, depth)
            if self.course.distance(footprint).min() >= front - _CLOSER_M and self.land.is_free(footprint):
                self.land.take(footprint)
                return start, along, wide - 0.02, width
        return None

    def _garden(self, solid: Builder, loose: Builder, origin: FloatArray, along: FloatArray, width: float) -> None:
        pose = upright(self.ground, origin, float(np.arctan2(along[1], along[0])))
        high = self.rng.uniform(1.2, 2.2)
        if self.rng.random() < 0.5:
            loose.place(plants.hedge(self.rng, width, high, 0.5), pose)
        else:
            solid.wall(origin, origin + width * along, (pose[2, 3] - 1.0, pose[2, 3] + high), 0.3)
        where = origin + 0.5 * width * along + 4.0 * np.array([-along[1], along[0]])
        loose.place(plants.broadleaf(self.rng, self.rng.uniform(6.0, 9.0), 0.16, 24), upright(self.ground, where, 0.0))

    def _cars(self, solid: Builder, side: Course) -> None:
        taken = min(self._share(_MOST_CARS, 6.0), self.rng.uniform(0.45, 0.8))
        for at in np.arange(4.0, side.length_m - 4.0, 6.0):
            if self.rng.random() > taken:
                continue
            where = side.beside(at, HALF_WIDTH_M - 1.15 + self.rng.uniform(-0.08, 0.08))
            ahead = side.beside(at + 2.0, 0.0) - side.beside(at - 2.0, 0.0)
            ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
            across = np.array([-ahead[1], ahead[0]])
            footprint = rectangle(where - 0.5 * (_CAR_M[0] * ahead + _CAR_M[1] * across), ahead, *_CAR_M)
            off = self.course.distance(footprint)
            # Not on the pavement behind a bend, nor where another part of the path has its lane.
            if off.min() < FREE_SIDE_M + 0.2 or off.max() > HALF_WIDTH_M + 0.3 or not self.land.is_free(footprint):
                continue
            self.land.take(footprint)
            yaw = float(np.arctan2(ahead[1], ahead[0]) + np.pi * (self.rng.random() < 0.85))
            solid.place(furnishing.car(self.rng), on_slope(self.ground, where, yaw, 3.0, 1.6))

    def _pavement(self, loose: Builder, side: Course) -> None:
        """Lamp posts at even distances, and between them trees, signs and bins, all close to the kerb."""
        leafy = self._share(_MOST_PLANTS, 8.0)
        for k, at in enumerate(np.arange(self.rng.uniform(1.0, 7.0), side.length_m, 8.0)):
            where, outward = side.beside(at, HALF_WIDTH_M + 0.9), side.beside(at, 1.0) - side.beside(at, 0.0)
            footprint = where[None]
            if self.course.distance(footprint)[0] < HALF_WIDTH_M + 0.7 or not self.land.is_free(footprint):
                continue
            self.land.take(footprint)
            pose = upright(self.ground, where, float(np.arctan2(-outward[1], -outward[0])))
            chance = self.rng.random()
            if k % 4 == 0:
                loose.place(furnishing.lamp_post(self.rng.uniform(5.0, 7.5), 1.3), pose)
            elif chance < 0.45 * leafy:
                high, radius = self.rng.uniform(6.0, 9.0), self.rng.uniform(0.12, 0.22)
                loose.place(plants.broadleaf(self.rng, high, radius, 30), pose)
            elif chance > 0.8:
                loose.place(furnishing.sign(self.rng), pose)
            elif chance > 0.7:
                loose.place(furnishing.litter_bin(), pose)

    def _clear(self, part: Builder) -> Builder:
        """The part without what may reach into the free space, whatever its height: twigs, the arm of a lamp."""
        boxes, cylinders = part.boxes, part.cylinders
        reach = np.linalg.norm(boxes.half_sizes, axis=1)
        keep_boxes = self.course.distance(boxes.centres[:, :2]) - reach > FREE_SIDE_M
        fraction = np.linspace(0.0, 1.0, 9)[:, None]
        steps = cylinders.ends - cylinders.starts
        axis = (cylinders.starts[:, None, :] + fraction * steps[:, None, :]).reshape(-1, 3)
        reach = 1.01 * cylinders.radii + np.linalg.norm(steps, axis=1) / 16.0
        distance = self.course.distance(axis[:, :2]).reshape(-1, len(fraction)).min(axis=1, initial=np.inf)
        return part.selected(keep_boxes, np.asarray(distance - reach > FREE_SIDE_M))
