"""The plan of a quarter: its streets, the ways round, and the lots for houses."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import left_of
from lidarslam.simulation.worlds.street.network import StreetNetwork

HALF_WIDTH_M = 6.0
_FILLET_M = 4.0
_DEPTHS_M = (8.0, 11.0)


@dataclass(frozen=True, eq=False)
class StreetPlan:
    """A quarter of one block or of two with a street between them, and dead ends that lead out of it."""

    network: StreetNetwork
    pavement_m: float  # width of the pavements
    tour: FloatArray  # (M, 2) corners of the carrier's way along the middle lines
    oncoming: FloatArray  # (K, 2) of a way that meets it, but crosses it nowhere if all keep to the right
    blocks: FloatArray  # (B, 2, 2) lowest and highest corner of each block, to the streets' middle lines


@dataclass(frozen=True, eq=False)
class Lot:
    """Land for one house, to the left of its front."""

    origin: FloatArray  # (2,) left end of the house's front as seen from within
    along: FloatArray  # (2,) direction of the front
    width: float
    depth: float
    setback_m: float = 0.0  # front garden between pavement and `origin`

    @property
    def inward(self) -> FloatArray:
        """(2,) from the street into the house."""
        return left_of(self.along)

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Its lowest and highest corner (2,)."""
        far = self.origin + self.width * self.along + self.depth * self.inward
        return np.minimum(self.origin, far), np.maximum(self.origin, far)


def _rectangle(west: float, east: float, height: float) -> FloatArray:
    return np.array([[west, 0.0], [east, 0.0], [east, height], [west, height]])


def draw_plan(rng: np.random.Generator) -> StreetPlan:
    """One block of 80 to 110 m, or two of 56 to 66 m that are driven round in the figure of an eight."""
    is_double = bool(rng.random() < 0.4)
    pavement = rng.uniform(3.4, 4.2)
    if is_double:
        outline = _rectangle(-float(rng.integers(56, 66)), float(rng.integers(56, 66)), float(rng.integers(52, 62)))
        shared = np.array([[0.0, 0.0], [0.0, outline[2, 1]]])
        first, second = outline[[3, 0]], outline[[2, 1]]
        tour = np.concatenate([shared, first, shared, second])
        oncoming = np.concatenate([shared, first])[::-1]
        blocks = np.array([[outline[0], shared[1]], [shared[0], outline[2]]])
    else:
        outline = _rectangle(0.0, float(rng.integers(80, 111)), float(rng.integers(80, 111)))
        tour = outline if rng.random() < 0.5 else outline[::-1]
        oncoming, blocks = tour[::-1], outline[None, [0, 2]]
    return StreetPlan(_draw_network(rng, outline, is_double), pavement, tour, oncoming, blocks)


def draw_terrace_plan(rng: np.random.Generator) -> StreetPlan:
    """One long, narrow block: two streets of about 400 m, and two short ones that join them."""
    outline = _rectangle(0.0, float(rng.integers(380, 461)), float(rng.integers(56, 71)))
    network = StreetNetwork(outline, tuple((k, (k + 1) % 4) for k in range(4)), HALF_WIDTH_M, _FILLET_M)
    tour = outline if rng.random() < 0.5 else outline[::-1]
    return StreetPlan(network, rng.uniform(3.4, 4.2), tour, tour[::-1], outline[None, [0, 2]])


def _draw_network(rng: np.random.Generator, outline: FloatArray, is_double: bool) -> StreetNetwork:
    """The streets round the outline (4, 2), counter-clockwise, with a middle street at x = 0 or none, and dead ends."""
    nodes: list[FloatArray] = []
    edges: list[tuple[int, int]] = []

    def node(at: FloatArray) -> int:
        for k, other in enumerate(nodes):
            if np.abs(other - at).max() < 0.5:
                return k
        nodes.append(at)
        return len(nodes) - 1

    for k, corner in enumerate(outline):
        step = outline[(k + 1) % 4] - corner
        length = float(np.abs(step).sum())
        along = step / length
        has_crossing = is_double and k % 2 == 0
        middle = abs(float(corner[0])) if has_crossing else round(rng.uniform(0.4, 0.6) * length)
        stops = {0.0, length, *([middle] if has_crossing else [])}
        if rng.random() < 0.65:
            stub = float(rng.choice([0.0, middle]))
            stops.add(stub)
            foot = corner + stub * along
            edges.append((node(foot), node(foot + rng.integers(28, 44) * -left_of(along))))
        edges += pairwise([node(corner + stop * along) for stop in sorted(stops)])
    if is_double:
        edges.append((node(np.array([0.0, 0.0])), node(np.array([0.0, outline[2, 1]]))))
    return StreetNetwork(np.array(nodes), tuple(edges), HALF_WIDTH_M, _FILLET_M)


@dataclass
class LotSurvey:
    """Lays out lots along all streets, none on a street or on another lot; `gaps` are lots without a house."""

    plan: StreetPlan
    lots: list[Lot] = field(default_factory=list)
    gaps: list[Lot] = field(default_factory=list)

    def walk(self, rng: np.random.Generator) -> None:
        """Go along each side of each street, dead ends first, and build up what is still free."""
        for start, length, along in self._frontages():
            at = 0.0
            while at < length:
                depth = rng.uniform(*_DEPTHS_M)
                setback = float(rng.choice([0.0, rng.uniform(0.2, 0.8), rng.uniform(2.5, 3.5)], p=[0.6, 0.25, 0.15]))
                lot = Lot(start + at * along, along, min(rng.uniform(7.0, 15.0), max(length - at, 6.5)), depth, setback)
                narrow = Lot(lot.origin, along, 6.5, depth)
                fitting = next((one for one in (lot, narrow) if self._is_free(one)), None)
                if fitting is None:
                    at += 0.5
                    continue
                self.lots.append(replace(fitting, origin=fitting.origin + fitting.setback_m * fitting.inward))
                at += fitting.width
                if rng.random() < 0.22:
                    gap = Lot(start + at * along, along, rng.uniform(2.5, 7.0), 6.0)
                    self.gaps += [gap] if self._is_free(gap) else []
                    at += gap.width

    def repeat(self, width_m: float, depth_m: float) -> None:
        """Build up each side of each street with lots that are all alike, none set back."""
        for start, length, along in self._frontages():
            at = 0.0
            while at + width_m <= length:
                lot = Lot(start + at * along, along, width_m, depth_m)
                is_free = self._is_free(lot)
                self.lots += [lot] if is_free else []
                at += width_m if is_free else 0.5

    def _frontages(self) -> Iterator[tuple[FloatArray, float, FloatArray]]:
        """Where each row of houses starts, how long it may be, and its direction."""
        network, front = self.plan.network, self.plan.network.half_width_m + self.plan.pavement_m
        is_dead = np.array([network.arms(k).sum() == 1.0 for k in range(len(network.nodes))])
        for a, b in network.edges:
            if is_dead[b]:  # dead ends are drawn from their foot
                ahead = (network.nodes[b] - network.nodes[a]) / np.linalg.norm(network.nodes[b] - network.nodes[a])
                along = -left_of(ahead)
                yield network.nodes[b] + front * (ahead - along), 2.0 * front, along
        beyond = front + _DEPTHS_M[1]
        dead_ends = network.nodes[is_dead]
        for side in network.sides():
            ends = (side.start, side.start + side.length_m * side.along)
            before, after = (0.0 if (dead_ends == at).all(axis=1).any() else beyond for at in ends)
            yield side.at(-before, front), before + side.length_m + after, side.along

    def _is_free(self, lot: Lot) -> bool:
        far = lot.origin + lot.width * lot.along + (lot.depth + lot.setback_m) * lot.inward
        low, high = np.minimum(lot.origin, far) + 0.02, np.maximum(lot.origin, far) - 0.02
        keep_off = self.plan.network.half_width_m + self.plan.pavement_m
        ends = self.plan.network.middle_lines
        if ((low < ends[:, 1] + keep_off) & (high > ends[:, 0] - keep_off)).all(axis=1).any():
            return False
        return not any((low < far).all() and (high > near).all() for near, far in self._taken())

    def _taken(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        return (lot.bounds for lot in (*self.lots, *self.gaps))
