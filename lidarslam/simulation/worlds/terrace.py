"""Terraced housing: the same house repeated along hundreds of metres, so that all periods look the same."""

import numpy as np

from lidarslam.simulation.world import Route, World
from lidarslam.simulation.worlds import outdoor, street
from lidarslam.simulation.worlds.building import heading
from lidarslam.simulation.worlds.houses import house
from lidarslam.simulation.worlds.outdoor import Grounds
from lidarslam.simulation.worlds.paths import grid_nodes, on_ground

# Hardly a slope: houses that step up with it would be distinguishable.
_HILLS_M = (0.05, 0.15)
_HOUSES_PER_LAMP = 5
# Grass between kerb and pavement.
_VERGE_M = (0.4, 1.8)
_GRASS_M = 0.1


def build(seed: int) -> World:
    """Two long terraces back to back, and the same across the street; lamp posts repeat with the houses."""
    rng = np.random.default_rng(seed)
    # One long, narrow block: two streets of about 400 m, and two short ones that join them.
    outline = street.rectangle((0.0, 0.0), (float(rng.integers(380, 461)), float(rng.integers(56, 71))))
    tour = outline if rng.random() < 0.5 else outline[::-1]
    edges = tuple((k, (k + 1) % 4) for k in range(4))
    plan = street.Quarter(outline, edges, rng.uniform(3.4, 4.2), tour, tour[::-1], outline[None, [0, 2]])
    ground = street.lay_ground(rng, plan, _HILLS_M)
    grounds = Grounds(rng, plan.tour, ground)
    width, depth = rng.uniform(5.2, 6.8), rng.uniform(8.0, 9.5)
    street.lay_kerbs(grounds.solid, plan.kerb_stones(), ground)
    alike = house(rng, width, depth, (False, False), (2, 3))
    for lot in street.repeated_lots(plan, width, depth):
        grounds.solid.place(alike, street.house_pose(ground, lot.origin, lot.along, lot.width))
    spacing_m = _HOUSES_PER_LAMP * width
    for side in plan.sides():  # lamp posts on the verges of both sides, opposite one another
        count = int((side.length_m - 2.0 * spacing_m) / spacing_m)
        for at in 0.5 * side.length_m + spacing_m * (np.arange(count + 1) - 0.5 * count):
            where = side.at(at, street.HALF_WIDTH_M + 0.9)
            grounds.put(outdoor.lamp_post(5.5, 1.3), where, heading(-side.outward))
    street.park_cars(grounds, plan, (0.02, 0.08))
    route = Route(on_ground(street.lane_of(plan.tour, 1.0), ground), 2.0, 1.8, 3.5, 14.0)  # 50 km/h
    movers = (*street.traffic(grounds, plan), *street.people(grounds, plan))
    far = ground.origin_xy + ground.cell_m * (np.array(ground.heights.shape) - 1)
    nodes = grid_nodes(ground.origin_xy, far, ground.cell_m)
    kerb = plan.kerb_distance(nodes.reshape(-1, 2)).reshape(ground.heights.shape)
    verge = np.minimum(kerb - _VERGE_M[0], _VERGE_M[1] - kerb)
    grass = outdoor.grass(rng, ground, np.full(kerb.shape, _GRASS_M), verge)
    return World("terrace", seed, route, *grounds.solid.solids, (ground,), movers, map_spacing_m=0.1, grass=grass)
