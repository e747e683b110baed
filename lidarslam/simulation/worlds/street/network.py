"""Streets as a graph of straight lines along the axes, and where road, pavement and kerb lie."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import left_of

_DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
KERB_WIDTH_M = 0.3
KERB_HEIGHT_M = 0.12
# The ground rises from road to pavement over one cell of its grid, from the kerb's foot on.
RISE_M = 0.5
STONE_M = 3.0


class Side(NamedTuple):
    """One side of a street: its middle line from a start (2,) along a direction (2,); the side is to the left."""

    start: FloatArray
    along: FloatArray
    length_m: float

    @property
    def outward(self) -> FloatArray:
        """(2,) away from the road."""
        return left_of(self.along)

    def at(self, along_m: float, left_m: float) -> FloatArray:
        """A place (2,) beside the middle line."""
        return self.start + along_m * self.along + left_m * self.outward


@dataclass(frozen=True, eq=False)
class StreetNetwork:
    """Middle lines of streets."""

    nodes: FloatArray  # (K, 2) crossings, corners and dead ends, at whole metres
    edges: tuple[tuple[int, int], ...]  # pairs of nodes, each pair on a line along x or y
    half_width_m: float  # from the middle line to the foot of the kerb, a multiple of `RISE_M`
    fillet_m: float  # radius of the kerb where two streets meet

    def arms(self, node: int) -> FloatArray:
        """(4,) whether a street leads from the node to +x, +y, -x, -y."""
        others = [b if a == node else a for a, b in self.edges if node in (a, b)]
        steps = self.nodes[others] - self.nodes[node]
        return np.asarray((np.sign(steps) @ _DIRECTIONS.T > 0.5).any(axis=0), dtype=np.float64)

    def corners(self) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, int]]:
        """The four quarters round each node: the node, the two directions that bound it, how many are streets."""
        for node, at in enumerate(self.nodes):
            arms = self.arms(node)
            for k in range(4):
                yield at, _DIRECTIONS[k], _DIRECTIONS[(k + 1) % 4], int(arms[k] + arms[(k + 1) % 4])

    def kerb_distance(self, xy: FloatArray) -> FloatArray:
        """Distance (N,) of points (N, 2) from the nearest kerb's foot, negative on the road."""
        distance = np.full(len(xy), np.inf)
        for low, high in self.middle_lines:
            aside = np.maximum(np.maximum(low - xy, xy - high), 0.0)
            distance = np.minimum(distance, np.hypot(aside[:, 0], aside[:, 1]) - self.half_width_m)
        reach = self.half_width_m + self.fillet_m
        for at, first, second, streets in self.corners():
            if streets == 2:
                middle = at + reach * (first + second)
                here = np.flatnonzero((np.abs(xy - at - 0.5 * (middle - at)) < 0.5 * reach).all(axis=1))
                fillet = self.fillet_m - np.linalg.norm(xy[here] - middle, axis=1)
                distance[here] = np.minimum(distance[here], fillet)
        return distance

    @cached_property
    def middle_lines(self) -> FloatArray:
        """(E, 2, 2) lowest and highest point of each street's middle line."""
        ends = self.nodes[np.array(self.edges)]
        return np.stack([ends.min(axis=1), ends.max(axis=1)], axis=1)

    def sides(self) -> Iterator[Side]:
        """Both sides of each street."""
        for edge in self.edges:
            for start, end in (self.nodes[list(edge)], self.nodes[list(edge[::-1])]):
                length = float(np.linalg.norm(end - start))
                yield Side(start, (end - start) / length, length)

    def kerb_stones(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Middle lines of the kerb's stones, from (2,) to (2,)."""
        middle = RISE_M - 0.5 * KERB_WIDTH_M
        reach = self.half_width_m + self.fillet_m
        for side in self.sides():
            end = side.start + side.length_m * side.along
            first = reach if self._leads(side.start, side.outward) else 0.0
            last = side.length_m - (reach if self._leads(end, side.outward) else 0.0)
            aside = (self.half_width_m + middle) * side.outward
            at = np.linspace(first, last, max(2, 1 + round((last - first) / STONE_M)))
            yield from pairwise(side.start + at[:, None] * side.along + aside)
        for node, one, other, streets in self.corners():
            if streets == 2:
                yield from pairwise(_quarter(node + reach * (one + other), -one, -other, self.fillet_m - middle))
            elif streets == 0:
                yield from pairwise(_quarter(node, one, other, self.half_width_m + middle))

    def _leads(self, at: FloatArray, direction: FloatArray) -> bool:
        """Whether a street leads that way from the node at (2,)."""
        node = int(np.abs(self.nodes - at).sum(axis=1).argmin())
        return bool(self.arms(node)[int((_DIRECTIONS @ direction).argmax())])


def _quarter(centre: FloatArray, one: FloatArray, other: FloatArray, radius: float) -> FloatArray:
    """Points (N, 2) on a quarter of a circle between two directions."""
    angle = np.linspace(0.0, 0.5 * np.pi, max(4, round(radius / 0.6)))[:, None]
    return np.asarray(centre + radius * (np.cos(angle) * one + np.sin(angle) * other))
