"""Worlds: boxes, cylinders and height fields, moving boxes, and a route through them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TypeVar, cast

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, make_transform, rotation_z

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Boxes:
    """Solid boxes in the world."""

    centres: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3)
    half_sizes: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) along its own axes, positive
    R_world_box: FloatArray = field(default_factory=lambda: np.empty((0, 3, 3)))  # (N, 3, 3)

    def __len__(self) -> int:
        return len(self.centres)


@dataclass(frozen=True, eq=False)
class Cylinders:
    """Solid cylinders with flat ends, in any direction: poles, trunks, pipes."""

    starts: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) centres of one end, in the world
    ends: FloatArray = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) and of the other
    radii: FloatArray = field(default_factory=lambda: np.empty(0))  # (N,) positive

    def __len__(self) -> int:
        return len(self.starts)


@dataclass(frozen=True, eq=False)
class HeightField:
    """A surface z(x, y) over a regular grid: ground, or with another one above it the rock around a tunnel.

    `heights` (X, Y) are z at `origin_xy + cell_m * (i, j)`; each cell is two triangles, split along the diagonal from
    (i, j) to (i + 1, j + 1).
    """

    origin_xy: FloatArray  # (2,)
    cell_m: float
    heights: FloatArray

    def height_at(self, xy: FloatArray) -> FloatArray:
        """z (N,) of the surface's triangles at (N, 2) world positions; outside the grid, that of its border."""
        limit = np.array(self.heights.shape, dtype=np.float64) - 1.0
        grid = np.clip((xy - self.origin_xy) / self.cell_m, 0.0, limit)
        low = np.minimum(grid.astype(np.int64), (limit - 1.0).astype(np.int64))
        u, v = (grid - low).T
        i, j = low.T
        h = self.heights
        z00, z11 = h[i, j], h[i + 1, j + 1]
        corner = np.where(u >= v, h[i + 1, j], h[i, j + 1])
        larger, smaller = np.maximum(u, v), np.minimum(u, v)
        return np.asarray(z00 + larger * (corner - z00) + smaller * (z11 - corner))


@dataclass(frozen=True, eq=False)
class Grass:
    """Blades on the ground, too thin and too many for primitives: returns among them are drawn for each scan."""

    heights: HeightField  # of the blades above the ground, 0 where none grow
    free_path_m: float  # mean path of a ray among the blades until one reflects it


@dataclass(frozen=True, eq=False)
class Mover:
    """Moving boxes that follow a closed polyline at constant speed, repeatedly."""

    boxes: Boxes  # in the mover's own frame, x forwards, the origin on the ground
    waypoints: FloatArray  # (M, 3) of the polyline, or one point for a mover that stands
    speed_mps: float
    start_m: float  # along the polyline at time 0

    def pose_at(self, times: FloatArray) -> FloatArray:
        """T_world_mover (N, 4, 4) at times (N,) in seconds, x along the polyline."""
        steps = np.roll(self.waypoints, -1, axis=0) - self.waypoints
        lengths = np.linalg.norm(steps, axis=1)
        if lengths.sum() <= 0.0:
            return make_transform(np.broadcast_to(np.eye(3), (len(times), 3, 3)), self.waypoints[:1])
        ends = np.cumsum(lengths)
        along = np.mod(self.start_m + self.speed_mps * times, ends[-1])
        leg = np.minimum(np.searchsorted(ends, along, side="right"), len(lengths) - 1)
        fraction = (along - (ends[leg] - lengths[leg])) / lengths[leg]
        R = rotation_z(np.arctan2(steps[leg, 1], steps[leg, 0]))
        return make_transform(R, self.waypoints[leg] + fraction[:, None] * steps[leg])


@dataclass(frozen=True, eq=False)
class Route:
    """A carrier's path; after the last waypoint it continues at the first, and so revisits every place."""

    waypoints: FloatArray  # (M, 3) corners of a closed polyline on the ground
    corner_radius_m: float  # how far a corner may be cut, which a car needs and a walker does not
    free_side_m: float  # free space to either side of the polyline
    free_height_m: float  # free space above the ground
    speed_limit_mps: float


@dataclass(frozen=True, eq=False)
class World:
    """A place to record in; the same name and seed make the same world.

    The reference map's points are `map_spacing_m` apart: 5 cm indoors, 10 cm outdoors, where surfaces are rougher and
    a map has millions of points. Grass is not in it.
    """

    name: str
    seed: int
    route: Route
    boxes: Boxes = field(default_factory=Boxes)
    cylinders: Cylinders = field(default_factory=Cylinders)
    height_fields: tuple[HeightField, ...] = ()
    movers: tuple[Mover, ...] = ()
    map_spacing_m: float = 0.05
    grass: Grass | None = None

    def ground_at(self, xy: FloatArray) -> FloatArray:
        """z (N,) of the first height field, which is the ground; 0 where there is none."""
        return self.height_fields[0].height_at(xy) if self.height_fields else np.zeros(len(xy))


# Each with the module of lidarslam.simulation.worlds that has a function of its name, which takes the seed.
WORLDS = {
    "street": "street", "office": "office", "tunnel": "tunnel", "forest": "countryside", "hall": "hall",
    "park": "countryside", "fields": "countryside", "ploughed": "countryside", "terrace": "street", "town": "town",
    "corridor": "hard_places", "stairs": "hard_places", "crowd": "hard_places",
}  # fmt: skip


def choose(kind: str, name: str, table: Mapping[str, T]) -> T:
    """The entry of that name; an InputError lists the known names."""
    if name not in table:
        raise InputError(f"no {kind} is called {name!r}; there are: {', '.join(table)}")
    return table[name]


def build_world(name: str, seed: int) -> World:
    """The world of that name and seed; the same two give the same world, bit for bit."""
    module = import_module(f"lidarslam.simulation.worlds.{choose('world', name, WORLDS)}")
    return cast(World, getattr(module, name)(seed))
