"""City streets round one block or two: houses, kerbs, parked and oncoming cars, trees, poles, people."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Mover, Route, World
from lidarslam.simulation.worlds import furnishing
from lidarslam.simulation.worlds.building import Builder, smooth_noise
from lidarslam.simulation.worlds.furnishing import on_slope, upright
from lidarslam.simulation.worlds.open_country import plants
from lidarslam.simulation.worlds.paths import offset_loop, on_ground, prune, round_corners, subdivide_loop, turns_left
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
    lay_kerbs(solid, plan, ground)
    _houses(solid, rng, survey, ground)
    _gardens(solid, green, rng, survey, ground)
    park_cars(solid, rng, plan, ground, (0.35, 0.85))
    _pavements(solid, green, rng, plan, ground)
    route = Route(on_ground(lane_of(plan.tour, 1.0), ground), 2.0, 1.8, 3.5, 11.0)
    solid.place(prune(green, route), np.eye(4))
    return World(
        "street",
        seed,
        route,
        boxes=solid.boxes,
        cylinders=solid.cylinders,
        height_fields=(ground,),
        movers=(*traffic(rng, plan, ground), *people(rng, plan, ground)),
        map_spacing_m=0.1,
    )


def lane_of(tour: FloatArray, step_m: float) -> FloatArray:
    """The middle (N, 2) of the right lane along a tour (M, 2)."""
    corners = offset_loop(tour, 0.5 * _LANE_M)
    radii = np.where(turns_left(corners), _LEFT_RADIUS_M, _RIGHT_RADIUS_M)
    return subdivide_loop(round_corners(corners, radii, step_m), 5.0)


def lay_ground(rng: np.random.Generator, plan: StreetPlan, hills_m: tuple[float, float]) -> HeightField:
    """Gentle slopes of that deviation, a cambered road, pavements a kerb higher, and roughness on all of it."""
    margin = plan.network.half_width_m + plan.pavement_m + 20.0
    low, high = plan.network.nodes.min(axis=0) - margin, plan.network.nodes.max(axis=0) + margin
    low = np.floor(low)  # nodes are at whole metres, so that a kerb is at grid points
    shape = tuple(np.ceil((high - low) / _CELL_M).astype(int) + 1)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    kerb = plan.network.kerb_distance((low + _CELL_M * grid).reshape(-1, 2)).reshape(shape)
    heights = rng.uniform(*hills_m) * smooth_noise(rng, shape, 40.0 / _CELL_M)
    heights += 0.02 * smooth_noise(rng, shape, 3.0 / _CELL_M) + 0.005 * smooth_noise(rng, shape, 0.7)
    heights += KERB_HEIGHT_M * np.clip(kerb / RISE_M, 0.0, 1.0)
    heights += 0.08 * (1.0 - (1.0 - np.clip(-kerb / plan.network.half_width_m, 0.0, 1.0)) ** 2)
    return HeightField(low, _CELL_M, heights)


def lay_kerbs(solid: Builder, plan: StreetPlan, ground: HeightField) -> None:
    """Kerb stones along all pavements."""
    for start, end in plan.network.kerb_stones():
        along = (end - start) / np.linalg.norm(end - start)
        ends = np.stack([start, end])
        # The stone's level is that of the pavement behind it, whichever side that is on.
        aside = 0.5 * KERB_WIDTH_M * np.array([-along[1], along[0]])
        z = np.maximum(ground.height_at(ends + aside), ground.height_at(ends - aside)) + 0.01
        a, b = np.column_stack([ends, z - 0.15])
        solid.beam(a, b, KERB_WIDTH_M, 0.3)


def _houses(solid: Builder, rng: np.random.Generator, survey: LotSurvey, ground: HeightField) -> None:
    for lot in survey.lots:
        sides = tuple(_is_open(survey, lot, x) for x in (-1.5, lot.width + 1.5))
        front = lot.origin + np.outer(np.linspace(0.0, lot.width, 5), lot.along)
        pose = upright(ground, lot.origin, float(np.arctan2(lot.along[1], lot.along[0])))
        pose[2, 3] = ground.height_at(front).mean()
        solid.place(house(rng, lot.width, lot.depth, (sides[0], sides[1])), pose)


def _is_open(survey: LotSurvey, lot: Lot, x: float) -> bool:
    """Whether a house's side can be seen from a street close by; x is just outside it."""
    beside = lot.origin + x * lot.along + 3.0 * lot.inward
    if survey.plan.network.kerb_distance(beside[None])[0] > survey.plan.pavement_m + 8.0:
        return False
    return not any((low < beside).all() and (beside < high).all() for low, high in (one.bounds for one in survey.lots))


def _gardens(solid: Builder, green: Builder, rng: np.random.Generator, survey: LotSurvey, ground: HeightField) -> None:
    """Walls and hedges across the gaps between houses and before front gardens, with trees behind them."""
    for lot in [*survey.gaps, *(lot for lot in survey.lots if lot.setback_m > 2.0)]:
        yaw = float(np.arctan2(lot.along[1], lot.along[0]))
        start = lot.origin - (lot.setback_m - 0.25) * lot.inward
        length, high = (lot.width - 1.4, rng.uniform(0.9, 1.4)) if lot.setback_m else (lot.width, rng.uniform(1.6, 2.2))
        pose = upright(ground, start, yaw)
        if rng.random() < 0.5:
            green.place(plants.hedge(rng, length, high, 0.5), pose)
        else:
            level = float(pose[2, 3])
            solid.wall(start, start + length * lot.along, (level - 1.0, level + high), 0.3)
        where = start + rng.uniform(0.3, 0.7) * length * lot.along
        where = where + (1.5 if lot.setback_m else rng.uniform(3.0, 5.0)) * lot.inward
        if lot.setback_m:
            green.place(plants.bush(rng, rng.uniform(0.5, 0.8), 14), upright(ground, where, 0.0))
        else:
            green.place(plants.broadleaf(rng, rng.uniform(5.0, 9.0), 0.16, 24), upright(ground, where, yaw))


def park_cars(
    solid: Builder, rng: np.random.Generator, plan: StreetPlan, ground: HeightField, taken_share: tuple[float, float]
) -> None:
    """Cars along the kerbs; the share of the places taken is drawn for each side of a street."""
    keep_off = plan.network.half_width_m + plan.network.fillet_m + 4.0
    for start, end, outward in plan.network.sides():
        along = (end - start) / np.linalg.norm(end - start)
        taken = rng.uniform(*taken_share)
        for at in np.arange(keep_off, np.linalg.norm(end - start) - keep_off, 6.0):
            if rng.random() > taken:
                continue
            offset = plan.network.half_width_m - 1.2 + rng.uniform(-0.08, 0.08)
            where = start + (at + rng.uniform(-0.4, 0.4)) * along + offset * outward
            heading = along if rng.random() < 0.15 else -along  # to the right of the road is against `along`
            yaw = float(np.arctan2(heading[1], heading[0]) + rng.normal(0.0, 0.015))
            solid.place(furnishing.car(rng), on_slope(ground, where, yaw, 3.0, 1.6))


def _pavements(solid: Builder, green: Builder, rng: np.random.Generator, plan: StreetPlan, ground: HeightField) -> None:
    """Lamp posts at even distances, and between them trees or signs, bins and shelters, all close to the kerb."""
    for start, end, outward in plan.network.sides():
        along = (end - start) / np.linalg.norm(end - start)
        yaw = float(np.arctan2(-outward[1], -outward[0]))
        is_avenue, lamp_height = rng.random() < 0.35, rng.uniform(5.0, 7.5)
        places = np.arange(rng.uniform(1.0, 7.0), np.linalg.norm(end - start), 8.0)
        for k, at in enumerate(places):
            where = start + at * along + (plan.network.half_width_m + 0.9) * outward
            if plan.network.kerb_distance(where[None])[0] < 0.85:
                continue
            pose = upright(ground, where, yaw)
            chance = rng.random()
            if k % 4 == 0:
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
                pose[:2, 3] += 0.5 * outward
                solid.place(furnishing.bus_shelter(rng), pose)


def traffic(rng: np.random.Generator, plan: StreetPlan, ground: HeightField) -> list[Mover]:
    """Cars on the other lane, all equally fast, so that none catches up with another."""
    waypoints = on_ground(lane_of(plan.oncoming, 0.25), ground)
    count, speed = int(rng.integers(3, 6)), rng.uniform(4.0, 8.0)
    length = float(np.linalg.norm(np.roll(waypoints, -1, axis=0) - waypoints, axis=1).sum())
    starts = length * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    return [Mover(furnishing.car(rng, round_wheels=False).boxes, waypoints, speed, float(at)) for at in starts]


def people(rng: np.random.Generator, plan: StreetPlan, ground: HeightField) -> list[Mover]:
    """Pedestrians round each block, on its own pavement, so that they cross no street."""
    movers = []
    inset = plan.network.half_width_m + plan.pavement_m - 1.0
    for low, high in plan.blocks:
        (x0, y0), (x1, y1) = low + inset, high - inset
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])[:: rng.choice([-1, 1])]
        waypoints = on_ground(subdivide_loop(round_corners(corners, np.full(4, 1.5), 0.25), 5.0), ground)
        count, speed = int(rng.integers(2, 5)), rng.uniform(0.9, 1.5)
        length = float(np.linalg.norm(np.roll(waypoints, -1, axis=0) - waypoints, axis=1).sum())
        starts = length * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
        movers += [Mover(furnishing.pedestrian(rng).boxes, waypoints, speed, float(at)) for at in starts]
    return movers
