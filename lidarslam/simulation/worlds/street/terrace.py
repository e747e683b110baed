"""Terraced housing: the same house again and again along hundreds of metres, so that every period looks alike."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Grass, HeightField, Route, World
from lidarslam.simulation.worlds import furnishing
from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.furnishing import upright
from lidarslam.simulation.worlds.open_country.meadow import grown
from lidarslam.simulation.worlds.paths import on_ground
from lidarslam.simulation.worlds.street.houses import house
from lidarslam.simulation.worlds.street.plan import LotSurvey, StreetPlan, draw_terrace_plan
from lidarslam.simulation.worlds.street.street import lane_of, lay_ground, lay_kerbs, park_cars, people, traffic

_SPEED_LIMIT_MPS = 14.0  # 50 km/h
# Hardly a slope: houses that step up with it would tell one from another.
_HILLS_M = (0.05, 0.15)
_PARKED_SHARE = (0.02, 0.08)
_STOREYS = (2, 3)
_HOUSES_PER_LAMP = 5
# Grass between kerb and pavement.
_VERGE_M = (0.4, 1.8)
_GRASS_M = 0.1


def build(seed: int) -> World:
    """Two long terraces back to back, with the like across the street; lamp posts keep step with the houses."""
    rng = np.random.default_rng(seed)
    plan = draw_terrace_plan(rng)
    ground = lay_ground(rng, plan, _HILLS_M)
    width, depth = rng.uniform(5.2, 6.8), rng.uniform(8.0, 9.5)
    survey = LotSurvey(plan)
    survey.repeat(width, depth)
    solid = Builder()
    lay_kerbs(solid, plan, ground)
    _houses(solid, house(rng, width, depth, (False, False), _STOREYS), survey, ground)
    _lamps(solid, plan, ground, _HOUSES_PER_LAMP * width)
    park_cars(solid, rng, plan, ground, _PARKED_SHARE)
    return World(
        "terrace",
        seed,
        Route(on_ground(lane_of(plan.tour, 1.0), ground), 2.0, 1.8, 3.5, _SPEED_LIMIT_MPS),
        boxes=solid.boxes,
        cylinders=solid.cylinders,
        height_fields=(ground,),
        movers=(*traffic(rng, plan, ground), *people(rng, plan, ground)),
        map_spacing_m=0.1,
        grass=_verges(rng, plan, ground),
    )


def _houses(solid: Builder, alike: Builder, survey: LotSurvey, ground: HeightField) -> None:
    for lot in survey.lots:
        front = lot.origin + np.outer(np.linspace(0.0, lot.width, 5), lot.along)
        pose = upright(ground, lot.origin, float(np.arctan2(lot.along[1], lot.along[0])))
        pose[2, 3] = ground.height_at(front).mean()
        solid.place(alike, pose)


def _lamps(solid: Builder, plan: StreetPlan, ground: HeightField, spacing_m: float) -> None:
    """Lamp posts on the verges of both sides, opposite one another."""
    for start, end, outward in plan.network.sides():
        length = float(np.linalg.norm(end - start))
        count = int((length - 2.0 * spacing_m) / spacing_m)
        yaw = float(np.arctan2(-outward[1], -outward[0]))
        for at in 0.5 * length + spacing_m * (np.arange(count + 1) - 0.5 * count):
            where = start + at * (end - start) / length + (plan.network.half_width_m + 0.9) * outward
            solid.place(furnishing.lamp_post(5.5, 1.3), upright(ground, where, yaw))


def _verges(rng: np.random.Generator, plan: StreetPlan, ground: HeightField) -> Grass:
    i, j = np.meshgrid(*(np.arange(n) for n in ground.heights.shape), indexing="ij")
    xy: FloatArray = ground.origin_xy + ground.cell_m * np.stack([i, j], axis=-1)
    kerb = plan.network.kerb_distance(xy.reshape(-1, 2)).reshape(ground.heights.shape)
    inside = np.minimum(kerb - _VERGE_M[0], _VERGE_M[1] - kerb)
    return grown(rng, ground, np.full(ground.heights.shape, _GRASS_M), inside)
