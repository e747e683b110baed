"""Terraced housing: the same house repeated along hundreds of metres, so that all periods look the same."""

import numpy as np

from lidarslam.simulation.world import Grass, HeightField, Route, World
from lidarslam.simulation.worlds import outdoor, street
from lidarslam.simulation.worlds.building import Builder, heading
from lidarslam.simulation.worlds.houses import house
from lidarslam.simulation.worlds.outdoor import upright
from lidarslam.simulation.worlds.paths import grid_nodes, on_ground
from lidarslam.simulation.worlds.street import LotSurvey, StreetPlan, draw_terrace_plan

_SPEED_LIMIT_MPS = 14.0  # 50 km/h
# Hardly a slope: houses that step up with it would be distinguishable.
_HILLS_M = (0.05, 0.15)
_PARKED_SHARE = (0.02, 0.08)
_STOREYS = (2, 3)
_HOUSES_PER_LAMP = 5
# Grass between kerb and pavement.
_VERGE_M = (0.4, 1.8)
_GRASS_M = 0.1


def build(seed: int) -> World:
    """Two long terraces back to back, and the same across the street; lamp posts repeat with the houses."""
    rng = np.random.default_rng(seed)
    plan = draw_terrace_plan(rng)
    ground = street.lay_ground(rng, plan, _HILLS_M)
    width, depth = rng.uniform(5.2, 6.8), rng.uniform(8.0, 9.5)
    survey = LotSurvey(plan)
    survey.repeat(width, depth)
    solid = Builder()
    street.lay_kerbs(solid, plan.network.kerb_stones(), ground)
    alike = house(rng, width, depth, (False, False), _STOREYS)
    for lot in survey.lots:
        solid.place(alike, street.house_pose(ground, lot.origin, lot.along, lot.width))
    _lamps(solid, plan, ground, _HOUSES_PER_LAMP * width)
    street.park_cars(solid, rng, plan, ground, _PARKED_SHARE)
    route = Route(on_ground(street.lane_of(plan.tour, 1.0), ground), 2.0, 1.8, 3.5, _SPEED_LIMIT_MPS)
    movers = (*street.traffic(rng, plan, ground), *street.people(rng, plan, ground))
    grass = _verges(rng, plan, ground)
    return World("terrace", seed, route, *solid.solids, (ground,), movers, map_spacing_m=0.1, grass=grass)


def _lamps(solid: Builder, plan: StreetPlan, ground: HeightField, spacing_m: float) -> None:
    """Lamp posts on the verges of both sides, opposite one another."""
    for side in plan.network.sides():
        count = int((side.length_m - 2.0 * spacing_m) / spacing_m)
        for at in 0.5 * side.length_m + spacing_m * (np.arange(count + 1) - 0.5 * count):
            where = side.at(at, plan.network.half_width_m + 0.9)
            solid.place(outdoor.lamp_post(5.5, 1.3), upright(ground, where, heading(-side.outward)))


def _verges(rng: np.random.Generator, plan: StreetPlan, ground: HeightField) -> Grass:
    shape = ground.heights.shape
    far = ground.origin_xy + ground.cell_m * (np.array(shape) - 1)
    nodes = grid_nodes(ground.origin_xy, far, ground.cell_m)
    kerb = plan.network.kerb_distance(nodes.reshape(-1, 2)).reshape(shape)
    inside = np.minimum(kerb - _VERGE_M[0], _VERGE_M[1] - kerb)
    return outdoor.grass(rng, ground, np.full(shape, _GRASS_M), inside)
