"""City streets round one block or two, and terraced housing: houses, kerbs, parked and oncoming cars, trees, poles."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import outdoor, paths
from lidarslam.simulation.worlds.building import Builder, Vector, heading, left_of, relief
from lidarslam.simulation.worlds.outdoor import Grounds, on_slope, upright

_DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
KERB_WIDTH_M = 0.3
_KERB_HEIGHT_M = 0.12
# The ground rises from road to pavement over one cell of its grid, from the kerb's foot on.
RISE_M = 0.5
STONE_M = 3.0
# From the middle line to the foot of the kerb, a multiple of `RISE_M`; radius of the kerb where two streets meet.
HALF_WIDTH_M, _FILLET_M = 6.0, 4.0
_REACH_M = HALF_WIDTH_M + _FILLET_M
_DEPTHS_M = (8.0, 11.0)
_LANE_M = 3.5
_LEFT_RADIUS_M, _RIGHT_RADIUS_M = 8.0, 5.0


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
        """A place (2,) by its distances along the middle line and outward from it."""
        return self.start + along_m * self.along + left_m * self.outward


@dataclass(frozen=True, eq=False)
class Quarter:
    """Streets round one block or round two with a street between them, and dead ends that lead out of it."""

    nodes: FloatArray  # (K, 2) crossings, corners and dead ends of the middle lines, at whole metres
    edges: tuple[tuple[int, int], ...]  # pairs of nodes, each pair on a line along x or y
    pavement_m: float  # width of the pavements
    tour: FloatArray  # (M, 2) corners of the carrier's path along the middle lines
    oncoming: FloatArray  # (K, 2) of a path that meets it, but crosses it nowhere if all keep to the right
    blocks: FloatArray  # (B, 2, 2) lowest and highest corner of each block, to the streets' middle lines

    @property
    def front_m(self) -> float:
        """From the middle line to the fronts of the houses."""
        return HALF_WIDTH_M + self.pavement_m

    def arms(self, node: int) -> FloatArray:
        """(4,) whether a street leads from the node to +x, +y, -x, -y."""
        others = [b if a == node else a for a, b in self.edges if node in (a, b)]
        steps = self.nodes[others] - self.nodes[node]
        return np.asarray((np.sign(steps) @ _DIRECTIONS.T > 0.5).any(axis=0), dtype=np.float64)

    def corners(self) -> Iterator[tuple[FloatArray, FloatArray, FloatArray, int]]:
        """The four quarters round each node: the node, its two directions, the number of streets among them."""
        for node, at in enumerate(self.nodes):
            arms = self.arms(node)
            for k in range(4):
                yield at, _DIRECTIONS[k], _DIRECTIONS[(k + 1) % 4], int(arms[k] + arms[(k + 1) % 4])

    def kerb_distance(self, xy: FloatArray) -> FloatArray:
        """Distance (N,) of points (N, 2) from the nearest kerb's foot, negative on the road."""
        distance = np.full(len(xy), np.inf)
        for low, high in self.middle_lines:
            aside = np.maximum(np.maximum(low - xy, xy - high), 0.0)
            distance = np.minimum(distance, np.hypot(aside[:, 0], aside[:, 1]) - HALF_WIDTH_M)
        for at, first, second, streets in self.corners():
            if streets == 2:
                middle = at + _REACH_M * (first + second)
                here = np.flatnonzero((np.abs(xy - at - 0.5 * (middle - at)) < 0.5 * _REACH_M).all(axis=1))
                fillet = _FILLET_M - np.linalg.norm(xy[here] - middle, axis=1)
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
        for side in self.sides():
            nodes = (np.abs(self.nodes - at).sum(axis=1).argmin() for at in (side.start, side.at(side.length_m, 0.0)))
            outward = int((_DIRECTIONS @ side.outward).argmax())
            first, until_end = (_REACH_M if self.arms(int(node))[outward] else 0.0 for node in nodes)
            last = side.length_m - until_end
            at = np.linspace(first, last, max(2, 1 + round((last - first) / STONE_M)))
            yield from pairwise(side.start + at[:, None] * side.along + (HALF_WIDTH_M + middle) * side.outward)
        for node, one, other, streets in self.corners():
            # An arc between the directions: inside a corner, or, where no street leads to either side, round an end.
            at, ahead, aside, radius = node, one, other, HALF_WIDTH_M + middle
            if streets == 2:
                at, ahead, aside, radius = node + _REACH_M * (one + other), -one, -other, _FILLET_M - middle
            angle = np.linspace(0.0, 0.5 * np.pi, max(4, round(radius / 0.6)))[:, None]
            if streets != 1:
                yield from pairwise(at + radius * (np.cos(angle) * ahead + np.sin(angle) * aside))


def rectangle(low: Vector, high: Vector) -> FloatArray:
    """Its corners (4, 2), counter-clockwise from the lowest."""
    return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])


def draw_quarter(rng: np.random.Generator) -> Quarter:
    """One block of 80 to 110 m, or two of 56 to 66 m with a tour in a figure of eight."""
    is_double, pavement = bool(rng.random() < 0.4), rng.uniform(3.4, 4.2)
    if is_double:
        west, east = -float(rng.integers(56, 66)), float(rng.integers(56, 66))
        outline = rectangle((west, 0.0), (east, float(rng.integers(52, 62))))
        shared = np.array([[0.0, 0.0], [0.0, outline[2, 1]]])
        tour = np.concatenate([shared, outline[[3, 0]], shared, outline[[2, 1]]])
        oncoming = np.concatenate([shared, outline[[3, 0]]])[::-1]
        blocks = np.array([[outline[0], shared[1]], [shared[0], outline[2]]])
    else:
        outline = rectangle((0.0, 0.0), (float(rng.integers(80, 111)), float(rng.integers(80, 111))))
        tour = outline if rng.random() < 0.5 else outline[::-1]
        oncoming, blocks = tour[::-1], outline[None, [0, 2]]
    return Quarter(*_draw_streets(rng, outline, is_double), pavement, tour, oncoming, blocks)


def _draw_streets(
    rng: np.random.Generator, outline: FloatArray, is_double: bool
) -> tuple[FloatArray, tuple[tuple[int, int], ...]]:
    """Nodes and edges round the outline (4, 2), with a middle street at x = 0 or none, and of dead ends."""
    nodes: dict[tuple[float, ...], int] = {}  # at whole metres
    edges: list[tuple[int, int]] = []

    def node(at: FloatArray) -> int:
        return nodes.setdefault(tuple(at), len(nodes))

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
    return np.array(list(nodes)), tuple(edges)


class Lot(NamedTuple):
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

    def bounds(self, further_m: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Its lowest and highest corner (2,), that much deeper than it is."""
        far = self.origin + self.width * self.along + (self.depth + further_m) * self.inward
        return np.minimum(self.origin, far), np.maximum(self.origin, far)

    def is_free(self, plan: Quarter, others: list["Lot"]) -> bool:
        """Whether it is on no street and on no other lot."""
        low, high = self.bounds(self.setback_m)
        low, high = low + 0.02, high - 0.02
        ends = plan.middle_lines
        if ((low < ends[:, 1] + plan.front_m) & (high > ends[:, 0] - plan.front_m)).all(axis=1).any():
            return False
        return not any((low < far).all() and (high > near).all() for near, far in (other.bounds() for other in others))


def draw_lots(plan: Quarter, rng: np.random.Generator) -> tuple[list[Lot], list[Lot]]:
    """Lots along the free parts of each side of each street, dead ends first; and gaps between them."""
    lots: list[Lot] = []
    gaps: list[Lot] = []
    for start, length, along in _frontages(plan):
        at = 0.0
        while at < length:
            depth = rng.uniform(*_DEPTHS_M)
            setback = float(rng.choice([0.0, rng.uniform(0.2, 0.8), rng.uniform(2.5, 3.5)], p=[0.6, 0.25, 0.15]))
            lot = Lot(start + at * along, along, min(rng.uniform(7.0, 15.0), max(length - at, 6.5)), depth, setback)
            narrow = Lot(lot.origin, along, 6.5, depth)
            fitting = next((one for one in (lot, narrow) if one.is_free(plan, lots + gaps)), None)
            if fitting is None:
                at += 0.5
                continue
            lots.append(fitting._replace(origin=fitting.origin + fitting.setback_m * fitting.inward))
            at += fitting.width
            if rng.random() < 0.22:
                gap = Lot(start + at * along, along, rng.uniform(2.5, 7.0), 6.0)
                gaps += [gap] if gap.is_free(plan, lots + gaps) else []
                at += gap.width
    return lots, gaps


def repeated_lots(plan: Quarter, width_m: float, depth_m: float) -> list[Lot]:
    """Equal lots along each side of each street, none set back."""
    lots: list[Lot] = []
    for start, length, along in _frontages(plan):
        at = 0.0
        while at + width_m <= length:
            lot = Lot(start + at * along, along, width_m, depth_m)
            is_free = lot.is_free(plan, lots)
            lots += [lot] if is_free else []
            at += width_m if is_free else 0.5
    return lots


def _frontages(plan: Quarter) -> Iterator[tuple[FloatArray, float, FloatArray]]:
    """Where each row of houses starts, how long it may be, and its direction."""
    front = plan.front_m
    is_dead = np.array([plan.arms(k).sum() == 1.0 for k in range(len(plan.nodes))])
    for a, b in plan.edges:
        if is_dead[b]:  # dead ends run from their foot
            ahead = (plan.nodes[b] - plan.nodes[a]) / np.linalg.norm(plan.nodes[b] - plan.nodes[a])
            along = -left_of(ahead)
            yield plan.nodes[b] + front * (ahead - along), 2.0 * front, along
    beyond = front + _DEPTHS_M[1]
    dead_ends = plan.nodes[is_dead]
    for side in plan.sides():
        ends = (side.start, side.start + side.length_m * side.along)
        before, after = (0.0 if (dead_ends == at).all(axis=1).any() else beyond for at in ends)
        yield side.at(-before, front), before + side.length_m + after, side.along


def street(seed: int) -> World:
    """A quarter of a city; everybody drives on the right."""
    rng = np.random.default_rng(seed)
    plan = draw_quarter(rng)
    ground, _ = lay_ground(rng, plan, (0.6, 1.1))
    lots, gaps = draw_lots(plan, rng)
    grounds = Grounds(rng, plan.tour, ground)
    lay_kerbs(grounds.solid, plan.kerb_stones(), ground)
    for lot in lots:
        sides = (_is_open(plan, lots, lot, -1.5), _is_open(plan, lots, lot, lot.width + 1.5))
        pose = house_pose(ground, lot.origin, lot.along, lot.width)
        grounds.solid.place(outdoor.house(rng, lot.width, lot.depth, sides), pose)
    for lot in [*gaps, *(lot for lot in lots if lot.setback_m > 2.0)]:
        _garden(grounds, lot)
    park_cars(grounds, plan, (0.35, 0.85))
    _pavements(grounds, plan)
    route = Route(paths.on_ground(lane_of(plan.tour, 1.0), ground), 2.0, 1.8, 3.5, 11.0)
    grounds.prune(route)
    movers = (*traffic(grounds, plan), *people(grounds, plan))
    return World("street", seed, route, *grounds.solid.solids, (ground,), movers, map_spacing_m=0.1)


def terrace(seed: int) -> World:
    """Two long terraces back to back, and the same across the street: all periods of the same house look the same."""
    rng = np.random.default_rng(seed)
    # One long, narrow block: two streets of about 400 m, and two short ones that join them.
    outline = rectangle((0.0, 0.0), (float(rng.integers(380, 461)), float(rng.integers(56, 71))))
    tour = outline if rng.random() < 0.5 else outline[::-1]
    edges = tuple((k, (k + 1) % 4) for k in range(4))
    plan = Quarter(outline, edges, rng.uniform(3.4, 4.2), tour, tour[::-1], outline[None, [0, 2]])
    # Hardly a slope: houses that step up with it would be distinguishable.
    ground, kerb = lay_ground(rng, plan, (0.05, 0.15))
    grounds = Grounds(rng, plan.tour, ground)
    width, depth = rng.uniform(5.2, 6.8), rng.uniform(8.0, 9.5)
    lay_kerbs(grounds.solid, plan.kerb_stones(), ground)
    alike = outdoor.house(rng, width, depth, (False, False), (2, 3))
    for lot in repeated_lots(plan, width, depth):
        grounds.solid.place(alike, house_pose(ground, lot.origin, lot.along, lot.width))
    spacing_m = 5 * width  # houses to a lamp post
    for side in plan.sides():  # lamp posts on the verges of both sides, opposite one another
        count = int((side.length_m - 2.0 * spacing_m) / spacing_m)
        for at in 0.5 * side.length_m + spacing_m * (np.arange(count + 1) - 0.5 * count):
            where = side.at(at, HALF_WIDTH_M + 0.9)
            grounds.put(outdoor.lamp_post(5.5, 1.3), where, heading(-side.outward))
    park_cars(grounds, plan, (0.02, 0.08))
    route = Route(paths.on_ground(lane_of(plan.tour, 1.0), ground), 2.0, 1.8, 3.5, 14.0)  # 50 km/h
    movers = (*traffic(grounds, plan), *people(grounds, plan))
    verge = np.minimum(kerb - 0.4, 1.8 - kerb)  # between kerb and pavement
    grass = outdoor.grass(rng, ground, np.full(kerb.shape, 0.1), verge)
    return World("terrace", seed, route, *grounds.solid.solids, (ground,), movers, map_spacing_m=0.1, grass=grass)


def lane_of(tour: FloatArray, step_m: float) -> FloatArray:
    """The middle (N, 2) of the right lane along a tour (M, 2)."""
    corners = paths.offset_loop(tour, 0.5 * _LANE_M)
    radii = np.where(paths.turning_angles(corners) > 0.0, _LEFT_RADIUS_M, _RIGHT_RADIUS_M)
    return paths.subdivide_loop(paths.round_corners(corners, radii, step_m), 5.0)


def lay_ground(rng: np.random.Generator, plan: Quarter, hills_m: tuple[float, float]) -> tuple[HeightField, FloatArray]:
    """Gentle slopes of that deviation with the surface of the streets on them, and the nodes' kerb distance (X, Y)."""
    margin = plan.front_m + 20.0
    # Nodes are at whole metres, so that a kerb is at grid points.
    low, nodes = paths.grid_around(plan.nodes, margin, RISE_M)
    kerb = plan.kerb_distance(nodes.reshape(-1, 2)).reshape(nodes.shape[:2])
    heights = relief(rng, kerb.shape, (rng.uniform(*hills_m), 40.0 / RISE_M))
    return HeightField(low, RISE_M, pave(rng, heights, kerb, RISE_M, HALF_WIDTH_M)), kerb


def pave(
    rng: np.random.Generator, hills: FloatArray, kerb: FloatArray, cell_m: float, half_width_m: float
) -> FloatArray:
    """Hills (X, Y) with a cambered road, pavements a kerb higher, and roughness, by the kerb's distance (X, Y)."""
    heights = hills + relief(rng, hills.shape, (0.02, 3.0 / cell_m), (0.005, 0.7))
    heights += _KERB_HEIGHT_M * np.clip(kerb / cell_m, 0.0, 1.0)
    return np.asarray(heights + 0.08 * (1.0 - (1.0 - np.clip(-kerb / half_width_m, 0.0, 1.0)) ** 2))


def lay_kerbs(solid: Builder, stones: Iterable[tuple[FloatArray, FloatArray]], ground: HeightField) -> None:
    """Kerb stones from (2,) to (2,), level with the pavement, whichever side that is on."""
    for start, end in stones:
        ends = np.stack([start, end])
        aside = 0.5 * KERB_WIDTH_M * left_of((end - start) / np.linalg.norm(end - start))
        z = np.maximum(ground.height_at(ends + aside), ground.height_at(ends - aside)) + 0.01
        a, b = np.column_stack([ends, z - 0.15])
        solid.beam(a, b, KERB_WIDTH_M, 0.3)


def house_pose(ground: HeightField, origin: FloatArray, along: FloatArray, width: float) -> FloatArray:
    """T_world_house (4, 4) with its front along (2,), level at the mean height of the pavement before it."""
    pose = upright(ground, origin, heading(along))
    pose[2, 3] = ground.height_at(origin + np.outer(np.linspace(0.0, width, 5), along)).mean()
    return pose


def _is_open(plan: Quarter, lots: list[Lot], lot: Lot, x: float) -> bool:
    """Whether a house's side can be seen from a street close by; x is just outside it."""
    beside = lot.origin + x * lot.along + 3.0 * lot.inward
    if plan.kerb_distance(beside[None])[0] > plan.pavement_m + 8.0:
        return False
    return not any((low < beside).all() and (beside < high).all() for low, high in (one.bounds() for one in lots))


def _garden(grounds: Grounds, lot: Lot) -> None:
    """A wall or a hedge across a gap between houses or before a front garden, with a tree or a bush behind it."""
    rng = grounds.rng
    start = lot.origin - (lot.setback_m - 0.25) * lot.inward
    length, high = (lot.width - 1.4, rng.uniform(0.9, 1.4)) if lot.setback_m else (lot.width, rng.uniform(1.6, 2.2))
    yaw, level = heading(lot.along), float(grounds.ground.height_at(start[None])[0])
    if rng.random() < 0.5:
        grounds.put(outdoor.hedge(rng, length, high, 0.5), start, yaw, is_green=True)
    else:
        grounds.solid.wall(start, start + length * lot.along, (level - 1.0, level + high), 0.3)
    where = start + rng.uniform(0.3, 0.7) * length * lot.along
    if lot.setback_m:
        bush = outdoor.bush(rng, rng.uniform(0.5, 0.8), 14)
        grounds.put(bush, where + 1.5 * lot.inward, 0.0, is_green=True)
    else:
        where = where + rng.uniform(3.0, 5.0) * lot.inward
        grounds.put(outdoor.broadleaf(rng, rng.uniform(5.0, 9.0), 0.16, 24), where, yaw, is_green=True)


def park_cars(grounds: Grounds, plan: Quarter, taken_share: tuple[float, float]) -> None:
    """Cars along the kerbs; the share of the places taken is drawn for each side of a street."""
    rng = grounds.rng
    for side in plan.sides():
        taken = rng.uniform(*taken_share)
        for at in np.arange(_REACH_M + 4.0, side.length_m - _REACH_M - 4.0, 6.0):
            if rng.random() > taken:
                continue
            offset = HALF_WIDTH_M - 1.2 + rng.uniform(-0.08, 0.08)
            where = side.at(at + rng.uniform(-0.4, 0.4), offset)
            ahead = side.along if rng.random() < 0.15 else -side.along  # to the right of the road is against `along`
            yaw = heading(ahead) + rng.normal(0.0, 0.015)
            grounds.solid.place(outdoor.car(rng), on_slope(grounds.ground, where, yaw, 3.0, 1.6))


def _pavements(grounds: Grounds, plan: Quarter) -> None:
    rng = grounds.rng
    for side in plan.sides():
        is_avenue, lamp_height = rng.random() < 0.35, rng.uniform(5.0, 7.5)
        for k, at in enumerate(np.arange(rng.uniform(1.0, 7.0), side.length_m, 8.0)):
            where = side.at(at, HALF_WIDTH_M + 0.9)
            if plan.kerb_distance(where[None])[0] >= 0.85:
                pose = upright(grounds.ground, where, heading(-side.outward))
                high = lamp_height if k % 4 == 0 else 0.0
                furnish_pavement(grounds.solid, grounds.green, rng, pose, high, is_avenue)


def furnish_pavement(
    solid: Builder, green: Builder, rng: np.random.Generator, pose: FloatArray, lamp_height: float, is_avenue: bool
) -> None:
    """A lamp post, or where its height is 0 a tree, a sign, bins, a shelter or nothing; x points to the road."""
    chance = rng.random()
    if lamp_height > 0.0:
        solid.place(outdoor.lamp_post(lamp_height, 1.3), pose)
    elif is_avenue:
        green.place(outdoor.broadleaf(rng, rng.uniform(6.0, 9.5), rng.uniform(0.12, 0.22), 36), pose)
    elif chance < 0.25:
        solid.place(outdoor.sign(rng), pose)
    elif chance < 0.4:
        solid.place(outdoor.litter_bin(), pose)
    elif chance < 0.5:
        solid.place(outdoor.bin_row(rng, int(rng.integers(1, 4))), pose)
    elif chance < 0.57:
        pose[:2, 3] -= 0.5 * pose[:2, 0]
        solid.place(outdoor.bus_shelter(rng), pose)


def traffic(grounds: Grounds, plan: Quarter) -> list[Mover]:
    """Cars on the other lane, all equally fast, so that none catches up with another."""
    rng, waypoints = grounds.rng, paths.on_ground(lane_of(plan.oncoming, 0.25), grounds.ground)
    return _movers(rng, waypoints, (3, 6), (4.0, 8.0), partial(outdoor.car, round_wheels=False))


def people(grounds: Grounds, plan: Quarter) -> list[Mover]:
    """Pedestrians round each block, on its own pavement, so that they cross no street."""
    rng, movers = grounds.rng, []
    for low, high in plan.blocks:
        corners = rectangle(low + plan.front_m - 1.0, high - plan.front_m + 1.0)[:: rng.choice([-1, 1])]
        loop = paths.subdivide_loop(paths.round_corners(corners, np.full(4, 1.5), 0.25), 5.0)
        waypoints = paths.on_ground(loop, grounds.ground)
        movers += _movers(rng, waypoints, (2, 5), (0.9, 1.5), outdoor.pedestrian)
    return movers


def _movers(
    rng: np.random.Generator, waypoints: FloatArray, counts: tuple[int, int], speeds_mps: tuple[float, float],
    draw: Callable[[np.random.Generator], Builder],
) -> list[Mover]:  # fmt: skip
    """Some of a kind on a closed polyline, equally fast, spread unevenly."""
    count, speed = int(rng.integers(*counts)), rng.uniform(*speeds_mps)
    starts = paths.loop_length(waypoints) * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    return [Mover(draw(rng).boxes, waypoints, speed, float(at)) for at in starts]
