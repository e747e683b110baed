"""A mine in rough rock: a loop of changing width and height, side galleries, and what was left in them."""

import numpy as np

from lidarslam.simulation.world import Route, World
from lidarslam.simulation.worlds.building import Builder
from lidarslam.simulation.worlds.tunnel.fittings import fit_out
from lidarslam.simulation.worlds.tunnel.plan import SPACING_M, draw_mine
from lidarslam.simulation.worlds.tunnel.rock import carve, place_stations

_WAYPOINT_M = 1.5
_FREE_SIDE_M, _FREE_HEIGHT_M = 0.8, 2.05


def build(seed: int) -> World:
    """The tunnel of that seed: ground and roof as height fields that meet in the walls, a loop of 150 to 300 m."""
    rng = np.random.default_rng(seed)
    plan = draw_mine(rng)
    rock = carve(plan, rng)
    builder = Builder()
    loop = plan.galleries[0]
    fit_out(place_stations(loop, rock, _FREE_SIDE_M, _FREE_HEIGHT_M), builder, rng)
    waypoints = loop.line[:: round(_WAYPOINT_M / SPACING_M)].copy()
    waypoints[:, 2] = rock.ground.height_at(waypoints[:, :2])
    route = Route(waypoints, 0.4, _FREE_SIDE_M, _FREE_HEIGHT_M, 1.5)
    return World("tunnel", seed, route, *builder.solids, (rock.ground, rock.roof))
