"""City streets round one block or two: houses, kerbs, parked and oncoming cars, trees, poles, people."""

from collections.abc import Iterable

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import furnishing, paths
from lidarslam.simulation.worlds.building import Builder, heading, left_of, smooth_noise
from lidarslam.simulation.worlds.furnishing import on_slope, upright
from lidarslam.simulation.worlds.open_country import plants
from lidarslam.simulation.worlds.street.houses import house
from lidarslam.simulation.worlds.street.network import KERB_HEIGHT_M, KERB_WIDTH_M, RISE_M
from lidarslam.simulation.worlds.street.plan import Lot, LotSurvey, StreetPlan, draw_plan

_LANE_M = 3.5
_LEFT_RADIUS_M, _RIGHT_RADIUS_M = 8.0, 5.0
_CELL_M = RISE_M


def build(seed: int) -> World:
    """A quarter of a city; everybody drives on the right."""
    rng = np.random.default_rng(seed)
    plan = draw_plan(rng)
    ground = lay_ground(rng, plan, (0.6, 1.1))
    survey = LotSurvey(plan)
    survey.walk(rng)
    solid, green = Builder(), Builder()
    lay_kerbs(solid, plan.network.kerb_stones(), ground)
    for lot in survey.lots:
        sides = (_is_open(survey, lot, -1.5), _is_open(survey, lot, lot.width + 1.5))
        pose = house_pose(ground, lot.origin, lot.along, lot.width)
        solid.place(house(rng, lot.width, lot.depth, sides), pose)
    for lot in [*survey.gaps, *(lot for lot in survey.lots if lot.setback_m > 2.0)]:
        _garden(solid, green, rng, lot, ground)
    park_cars(solid, rng, plan, ground, (0.35, 0.85))
    _pavements(solid, green, rng, plan, ground)
    route = Route(paths.on_ground(lane_of(plan.tour, 1.0), ground), 2.0, 1.8, 3.5, 11.0)
    solid.place(paths.prune(green, route), np.eye(4))
    movers = (*traffic(rng, plan, ground), *people(rng, plan, ground))
    return World("street", seed, route, *solid.solids, (ground,), movers, map_spacing_m=0.1)


def lane_of(tour: FloatArray, step_m: float) -> FloatArray:
    """The middle (N, 2) of the right lane along a tour (M, 2)."""
    corners = paths.offset_loop(tour, 0.5 * _LANE_M)
    radii = np.where(paths.turns_left(corners), _LEFT_RADIUS_M, _RIGHT_RADIUS_M)
    return paths.subdivide_loop(paths.round_corners(corners, radii, step_m), 5.0)


def lay_ground(rng: np.random.Generator, plan: StreetPlan, hills_m: tuple[float, float]) -> HeightField:
    """Gentle slopes of that deviation, with the surface of the streets on them."""
    margin = plan.network.half_width_m + plan.pavement_m + 20.0
    # Nodes are at whole metres, so that a kerb is at grid points.
    low = np.floor(plan.network.nodes.min(axis=0) - margin)
    nodes = paths.grid_nodes(low, plan.network.nodes.max(axis=0) + margin, _CELL_M)
    kerb = plan.network.kerb_distance(nodes.reshape(-1, 2)).reshape(nodes.shape[:2])
    heights = rng.uniform(*hills_m) * smooth_noise(rng, kerb.shape, 40.0 / _CELL_M)
    return HeightField(low, _CELL_M, pave(rng, heights, kerb, _CELL_M, plan.network.half_width_m))


def pave(
    rng: np.random.Generator, hills: FloatArray, kerb: FloatArray, cell_m: float, half_width_m: float
) -> FloatArray:
    """Hills (X, Y) with a cambered road, pavements a kerb higher, and roughness, by the kerb's distance (X, Y)."""
    shape = hills.shape
    heights = hills + (0.02 * smooth_noise(rng, shape, 3.0 / cell_m) + 0.005 * smooth_noise(rng, shape, 0.7))
    heights += KERB_HEIGHT_M * np.clip(kerb / cell_m, 0.0, 1.0)
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


def _is_open(survey: LotSurvey, lot: Lot, x: float) -> bool:
    """Whether a house's side can be seen from a street close by; x is just outside it."""
    beside = lot.origin + x * lot.along + 3.0 * lot.inward
    if survey.plan.network.kerb_distance(beside[None])[0] > survey.plan.pavement_m + 8.0:
        return False
    return not any((low < beside).all() and (beside < high).all() for low, high in (one.bounds for one in survey.lots))


def _garden(solid: Builder, green: Builder, rng: np.random.Generator, lot: Lot, ground: HeightField) -> None:
    """A wall or a hedge across a gap between houses or before a front garden, with a tree or a bush behind it."""
    start = lot.origin - (lot.setback_m - 0.25) * lot.inward
    length, high = (lot.width - 1.4, rng.uniform(0.9, 1.4)) if lot.setback_m else (lot.width, rng.uniform(1.6, 2.2))
    pose = upright(ground, start, heading(lot.along))
    if rng.random() < 0.5:
        green.place(plants.hedge(rng, length, high, 0.5), pose)
    else:
        solid.wall(start, start + length * lot.along, (pose[2, 3] - 1.0, pose[2, 3] + high), 0.3)
    where = start + rng.uniform(0.3, 0.7) * length * lot.along
    where = where + (1.5 if lot.setback_m else rng.uniform(3.0, 5.0)) * lot.inward
    if lot.setback_m:
        green.place(plants.bush(rng, rng.uniform(0.5, 0.8), 14), upright(ground, where, 0.0))
    else:
        green.place(plants.broadleaf(rng, rng.uniform(5.0, 9.0), 0.16, 24), upright(ground, where, heading(lot.along)))


def park_cars(
    solid: Builder, rng: np.random.Generator, plan: StreetPlan, ground: HeightField, taken_share: tuple[float, float]
) -> None:
    """Cars along the kerbs; the share of the places taken is drawn for each side of a street."""
    keep_off = plan.network.half_width_m + plan.network.fillet_m + 4.0
    for side in plan.network.sides():
        taken = rng.uniform(*taken_share)
        for at in np.arange(keep_off, side.length_m - keep_off, 6.0):
            if rng.random() > taken:
                continue
            offset = plan.network.half_width_m - 1.2 + rng.uniform(-0.08, 0.08)
            where = side.at(at + rng.uniform(-0.4, 0.4), offset)
            ahead = side.along if rng.random() < 0.15 else -side.along  # to the right of the road is against `along`
            yaw = heading(ahead) + rng.normal(0.0, 0.015)
            solid.place(furnishing.car(rng), on_slope(ground, where, yaw, 3.0, 1.6))


def _pavements(solid: Builder, green: Builder, rng: np.random.Generator, plan: StreetPlan, ground: HeightField) -> None:
    for side in plan.network.sides():
        is_avenue, lamp_height = rng.random() < 0.35, rng.uniform(5.0, 7.5)
        for k, at in enumerate(np.arange(rng.uniform(1.0, 7.0), side.length_m, 8.0)):
            where = side.at(at, plan.network.half_width_m + 0.9)
            if plan.network.kerb_distance(where[None])[0] >= 0.85:
                pose = upright(ground, where, heading(-side.outward))
                furnish_pavement(solid, green, rng, pose, lamp_height if k % 4 == 0 else 0.0, is_avenue)


def furnish_pavement(
    solid: Builder, green: Builder, rng: np.random.Generator, pose: FloatArray, lamp_height: float, is_avenue: bool
) -> None:
    """A lamp post, or where its height is 0 a tree, a sign, bins, a shelter or nothing; x points to the road."""
    chance = rng.random()
    if lamp_height > 0.0:
        solid.place(furnishing.lamp_post(lamp_height, 1.3), pose)
    elif is_avenue:
        green.place(plants.broadleaf(rng, rng.uniform(6.0, 9.5), rng.uniform(0.12, 0.22), 36), pose)
    elif chance < 0.25:
        solid.place(furnishing.sign(rng), pose)
    elif chance < 0.4:
        solid.place(furnishing.litter_bin(), pose)
    elif chance < 0.5:
        solid.place(furnishing.bin_row(rng, int(rng.integers(1, 4))), pose)
    elif chance < 0.57:
        pose[:2, 3] -= 0.5 * pose[:2, 0]
        solid.place(furnishing.bus_shelter(rng), pose)


def traffic(rng: np.random.Generator, plan: StreetPlan, ground: HeightField) -> list[Mover]:
    """Cars on the other lane, all equally fast, so that none catches up with another."""
    waypoints = paths.on_ground(lane_of(plan.oncoming, 0.25), ground)
    count, speed = int(rng.integers(3, 6)), rng.uniform(4.0, 8.0)
    starts = _starts(rng, count, waypoints)
    return [Mover(furnishing.car(rng, round_wheels=False).boxes, waypoints, speed, at) for at in starts]


def people(rng: np.random.Generator, plan: StreetPlan, ground: HeightField) -> list[Mover]:
    """Pedestrians round each block, on its own pavement, so that they cross no street."""
    movers = []
    inset = plan.network.half_width_m + plan.pavement_m - 1.0
    for low, high in plan.blocks:
        (x0, y0), (x1, y1) = low + inset, high - inset
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])[:: rng.choice([-1, 1])]
        loop = paths.subdivide_loop(paths.round_corners(corners, np.full(4, 1.5), 0.25), 5.0)
        waypoints = paths.on_ground(loop, ground)
        count, speed = int(rng.integers(2, 5)), rng.uniform(0.9, 1.5)
        starts = _starts(rng, count, waypoints)
        movers += [Mover(furnishing.pedestrian(rng).boxes, waypoints, speed, at) for at in starts]
    return movers


def _starts(rng: np.random.Generator, count: int, waypoints: FloatArray) -> list[float]:
    """Where along a closed polyline so many movers start, spread unevenly."""
    at = paths.loop_length(waypoints) * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    return [float(one) for one in at]
