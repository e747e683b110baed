"""Furniture, each piece drawn in its own frame: x along the wall it stands at, y away from it, z up from the floor."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import Builder, rotation_z

# Things hover or touch at a millimetre, so that no two faces lie in one plane.
HAIR_M = 0.002


@dataclass(frozen=True)
class Spot:
    """A place to draw at: a frame on the floor, turned about the vertical.

    Attributes:
        builder: what is drawn into.
        origin: (3,) in the world.
        yaw: of the spot's x axis in the world.
    """

    builder: Builder
    origin: FloatArray
    yaw: float

    def point(self, x: float, y: float, z: float) -> FloatArray:
        """A point (3,) of the spot, in the world."""
        return np.asarray(self.origin + rotation_z(self.yaw) @ np.array([x, y, z]))

    def shifted(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> "Spot":
        """A spot within this one."""
        return Spot(self.builder, self.point(x, y, z), self.yaw + yaw)

    def box(self, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> None:
        """A box between the given limits on the spot's axes."""
        centre = self.point(0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]), 0.5 * (z[0] + z[1]))
        self.builder.box(centre, (x[1] - x[0], y[1] - y[0], z[1] - z[0]), yaw=self.yaw)

    def rod(self, start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> None:
        """A cylinder between two points of the spot."""
        self.builder.cylinder(self.point(*start), self.point(*end), radius)


def desk(spot: Spot, width: float, depth: float, rng: np.random.Generator) -> None:
    """A desk with legs, a drawer unit, and a screen or two."""
    top, half = rng.uniform(0.70, 0.76), 0.5 * width
    spot.box((-half, half), (0.0, depth), (top, top + 0.035))
    for x in (-half + 0.04, half - 0.04):
        spot.box((x - 0.025, x + 0.025), (0.06, depth - 0.06), (0.0, top))
    side = rng.choice([-1.0, 1.0])
    spot.box(tuple(sorted((side * (half - 0.5), side * (half - 0.08)))), (0.08, depth - 0.1), (0.0, 0.58))
    for k in range(int(rng.integers(1, 3))):
        x = (k - 0.5) * 0.58 + rng.uniform(-0.05, 0.05)
        spot.box((x - 0.27, x + 0.27), (0.16, 0.19), (top + 0.14, top + 0.48))
        spot.box((x - 0.1, x + 0.1), (0.12, 0.28), (top + 0.035, top + 0.05))
        spot.box((x - 0.03, x + 0.03), (0.19, 0.21), (top + 0.05, top + 0.2))
    spot.box((-0.22, 0.22), (0.42, 0.56), (top + 0.035, top + 0.06))


def chair(spot: Spot, rng: np.random.Generator) -> None:
    """A chair on five castors or four legs, its back towards +y of the spot."""
    seat = rng.uniform(0.43, 0.5)
    spot.box((-0.23, 0.23), (-0.23, 0.23), (seat, seat + 0.06))
    spot.box((-0.21, 0.21), (0.2, 0.26), (seat + 0.12, seat + 0.52))
    spot.box((-0.03, 0.03), (0.2, 0.24), (seat - 0.02, seat + 0.3))
    if rng.random() < 0.6:
        spot.rod((0.0, 0.0, 0.08), (0.0, 0.0, seat), 0.03)
        for angle in np.arange(5) * 0.4 * np.pi:
            spot.rod((0.0, 0.0, 0.09), (0.29 * np.cos(angle), 0.29 * np.sin(angle), 0.04), 0.022)
    else:
        for x, y in ((-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2), (0.2, 0.2)):
            spot.rod((x, y, 0.0), (x, y, seat), 0.017)


def shelf(spot: Spot, width: float, depth: float, height: float, rng: np.random.Generator) -> None:
    """An open shelf with a back, boards, and rows of books and boxes."""
    half = 0.5 * width
    spot.box((-half, half), (0.0, 0.02), (0.0, height))
    for x in (-half, half - 0.03):
        spot.box((x, x + 0.03), (0.02, depth), (0.0, height))
    boards = np.linspace(0.06, height - 0.03, max(2, round(height / 0.38) + 1))
    for z, above in pairwise(boards):
        spot.box((-half + 0.03, half - 0.03), (0.02, depth - 0.01), (z, z + 0.025))
        _goods(spot, (-half + 0.05, half - 0.05), depth, (z + 0.025, above - 0.03), rng)
    spot.box((-half + 0.03, half - 0.03), (0.02, depth - 0.01), (boards[-1], boards[-1] + 0.025))


def _goods(spot: Spot, x: tuple[float, float], depth: float, z: tuple[float, float], rng: np.random.Generator) -> None:
    """Blocks of books or boxes in a row, with gaps."""
    at = x[0]
    while at < x[1] - 0.15:
        length = min(rng.uniform(0.15, 0.5), x[1] - at)
        if rng.random() < 0.75:
            spot.box(
                (at, at + length),
                (0.03, depth * rng.uniform(0.55, 0.95)),
                (z[0], z[0] + (z[1] - z[0]) * rng.uniform(0.5, 0.95)),
            )
        at += length + rng.choice([0.01, 0.12])


def cabinet(spot: Spot, width: float, depth: float, height: float, rng: np.random.Generator) -> None:
    """A closed cabinet on a plinth, with doors or drawers standing a little proud, and handles."""
    half = 0.5 * width
    spot.box((-half + 0.02, half - 0.02), (0.0, depth - 0.05), (0.0, 0.08))
    spot.box((-half, half), (0.0, depth - 0.02), (0.08, height))
    columns = max(1, round(width / 0.45))
    rows = 1 if rng.random() < 0.5 else max(2, round(height / 0.4))
    xs, zs = np.linspace(-half, half, columns + 1), np.linspace(0.08, height, rows + 1)
    for x0, x1 in pairwise(xs):
        for z0, z1 in pairwise(zs):
            spot.box((x0 + 0.01, x1 - 0.01), (depth - 0.02, depth), (z0 + 0.01, z1 - 0.01))


def table(spot: Spot, width: float, depth: float, rng: np.random.Generator) -> None:
    """A long table on two trestles, its middle at the spot."""
    a, b = 0.5 * width, 0.5 * depth
    spot.box((-a, a), (-b, b), (0.72, 0.76))
    for x in (-a + 0.3, a - 0.3):
        spot.box((x - 0.04, x + 0.04), (-b + 0.15, b - 0.15), (0.0, 0.72))
    for _ in range(int(rng.integers(0, 4))):
        x, y = rng.uniform(-a + 0.2, a - 0.2), rng.uniform(-b + 0.2, b - 0.2)
        spot.shifted(x, y, 0.76, rng.uniform(0.0, 3.0)).box(
            (-0.15, 0.15), (-0.11, 0.11), (0.0, rng.uniform(0.02, 0.25))
        )


def round_table(spot: Spot, radius: float) -> None:
    """A round table on one foot, its middle at the spot."""
    spot.rod((0.0, 0.0, 0.72), (0.0, 0.0, 0.75), radius)
    spot.rod((0.0, 0.0, 0.02), (0.0, 0.0, 0.72), 0.045)
    spot.rod((0.0, 0.0, 0.0), (0.0, 0.0, 0.02), 0.55 * radius)


def sofa(spot: Spot, width: float, rng: np.random.Generator) -> None:
    """A sofa with its back to the wall, 0.85 m deep."""
    half, seat = 0.5 * width, rng.uniform(0.38, 0.44)
    spot.box((-half, half), (0.04, 0.85), (0.06, seat - 0.1))
    spot.box((-half, half), (0.0, 0.22), (0.06, seat + 0.4))
    for x in (-half, half - 0.16):
        spot.box((x, x + 0.16), (0.1, 0.83), (0.06, seat + 0.18))
    cushions = max(1, round((width - 0.32) / 0.65))
    edges = np.linspace(-half + 0.16, half - 0.16, cushions + 1)
    for x0, x1 in pairwise(edges):
        spot.box((x0 + 0.01, x1 - 0.01), (0.2, 0.84), (seat - 0.1, seat))


def plant(spot: Spot, height: float, rng: np.random.Generator) -> None:
    """A pot with leaves standing out to all sides, about 0.35 m around its middle."""
    pot = rng.uniform(0.28, 0.42)
    spot.rod((0.0, 0.0, 0.0), (0.0, 0.0, pot), rng.uniform(0.14, 0.19))
    spot.rod((0.0, 0.0, pot), (0.0, 0.0, 0.75 * height), 0.02)
    for _ in range(int(rng.integers(9, 15))):
        angle, rise = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.3, 1.2)
        direction = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        side = np.array([-np.sin(angle), np.cos(angle), 0.0])
        R = rotation_z(spot.yaw) @ np.stack([direction, side, np.cross(direction, side)], axis=1)
        length = rng.uniform(0.22, 0.34)
        root = np.array([0.0, 0.0, rng.uniform(pot, 0.78 * height)])
        centre = spot.origin + rotation_z(spot.yaw) @ (root + 0.5 * length * direction)
        spot.builder.box(centre, (length, rng.uniform(0.06, 0.14), 0.012), R=R)


def board(spot: Spot, width: float, low: float, high: float) -> None:
    """A board with a frame on the wall: white board, notice board, picture."""
    half = 0.5 * width
    spot.box((-half, half), (0.0, 0.02), (low, high))
    for z in (low, high - 0.03):
        spot.box((-half, half), (0.02, 0.035), (z, z + 0.03))


def radiator(spot: Spot, width: float) -> None:
    """A ribbed radiator a hand's breadth above the floor, 0.12 m deep."""
    for x in np.arange(-0.5 * width, 0.5 * width - 0.05, 0.12):
        spot.box((x, x + 0.09), (0.04, 0.12), (0.12, 0.68))
    spot.rod((-0.5 * width, 0.07, 0.17), (0.5 * width, 0.07, 0.17), 0.02)
    spot.rod((-0.5 * width, 0.07, 0.62), (0.5 * width, 0.07, 0.62), 0.02)


def partition(spot: Spot, width: float, height: float) -> None:
    """A free-standing screen with feet, its middle line on the spot's x axis."""
    half = 0.5 * width
    spot.box((-half, half), (-0.025, 0.025), (0.04, height))
    for x in (-half + 0.15, half - 0.15):
        spot.box((x - 0.03, x + 0.03), (-0.2, 0.2), (0.0, 0.04))


def counter(spot: Spot, width: float, rng: np.random.Generator) -> None:
    """A kitchen counter 0.6 m deep with cupboards over it, a sink's tap and a machine on it."""
    half = 0.5 * width
    cabinet(spot, width, 0.58, 0.86, rng)
    spot.box((-half, half), (0.0, 0.62), (0.86, 0.9))
    cabinet(spot.shifted(0.0, 0.0, 1.4), width, 0.34, 0.7, rng)
    spot.rod((-0.3 * width, 0.12, 0.9), (-0.3 * width, 0.12, 1.18), 0.015)
    spot.rod((-0.3 * width, 0.12, 1.17), (-0.3 * width, 0.3, 1.15), 0.012)
    x = rng.uniform(0.0, 0.25 * width)
    spot.box((x, x + 0.3), (0.1, 0.45), (0.9, rng.uniform(1.15, 1.3)))
