"""Open, rolling fields with a road round them: grass and crops, and of fences, hedges, trees and poles only a few."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import HeightField, Route, World
from lidarslam.simulation.worlds.building import Builder, smooth_noise
from lidarslam.simulation.worlds.open_country import field_things
from lidarslam.simulation.worlds.open_country.meadow import grown
from lidarslam.simulation.worlds.paths import distance_to_loop, on_ground, prune, resample_loop, round_corners

_CELL_M = 0.75
_MARGIN_M = 70.0
_ROAD_HALF_M = 2.8
_FREE_SIDE_M = 2.4
_SPEED_LIMIT_MPS = 28.0  # 100 km/h
_WAYPOINT_SPACING_M = 2.0


def build(seed: int) -> World:
    """Fields; a road of two gently winding kilometres that can be driven at 30 m/s for half of it."""
    rng = np.random.default_rng(seed)
    road = _road(rng)
    low, distance = _distances(road)
    ground = _ground(rng, low, distance)
    solid, green = Builder(), Builder()
    field_things.poles(solid, rng, road, ground)
    field_things.fences(solid, rng, road, ground)
    field_things.barn(solid, rng, road, ground)
    field_things.bales(solid, rng, road, ground)
    field_things.hedges(green, rng, road, ground)
    field_things.trees(green, rng, road, ground, _MARGIN_M)
    waypoints = resample_loop(road, _WAYPOINT_SPACING_M)[1:]  # a leg of twice the length: a lap begins in its middle
    route = Route(on_ground(waypoints, ground), 3.0, _FREE_SIDE_M, 4.0, _SPEED_LIMIT_MPS)
    solid.place(prune(green, route), np.eye(4))
    return World(
        "fields",
        seed,
        route,
        boxes=solid.boxes,
        cylinders=solid.cylinders,
        height_fields=(ground,),
        map_spacing_m=0.1,
        grass=grown(rng, ground, _parcels(rng, distance), distance - _ROAD_HALF_M),
    )


def _road(rng: np.random.Generator) -> FloatArray:
    """A long closed line (N, 2), points half a metre apart: two sides that sway gently, joined by wide bends.

    It begins a quarter along a side; the sides' bends are wider than 250 m, so that 3.5 m/s^2 across allow 30 m/s.
    """
    side, radius = rng.uniform(560.0, 640.0), rng.uniform(95.0, 115.0)
    corners = np.array([[-0.5, -1.0], [0.5, -1.0], [0.5, 1.0], [-0.5, 1.0]]) * [side + 2.0 * radius, radius]
    loop = resample_loop(round_corners(corners, np.full(4, 0.999 * radius), 2.0), 0.5)
    for amplitude, wave in ((rng.uniform(6.0, 10.0), 450.0), (rng.uniform(1.0, 2.5), 230.0)):
        phase = rng.uniform(0.0, 2.0 * np.pi)
        loop[:, 1] += amplitude * np.sin(2.0 * np.pi * loop[:, 0] / wave + phase)
    begin = np.abs(loop - [-0.25 * side, loop[:, 1].min()]).sum(axis=1).argmin()
    return np.roll(loop, -begin, axis=0)[:: rng.choice([-1, 1])]


def _distances(road: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The ground's lowest corner (2,), and how far (X, Y) its grid points are from the road's middle, up to 12 m."""
    low = np.floor(road.min(axis=0) - _MARGIN_M)
    shape = tuple(np.ceil((road.max(axis=0) + _MARGIN_M - low) / _CELL_M).astype(int) + 1)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1)
    return low, distance_to_loop((low + _CELL_M * grid).reshape(-1, 2), road, 12.0).reshape(shape)


def _ground(rng: np.random.Generator, low: FloatArray, distance: FloatArray) -> HeightField:
    """Swells some 150 m long and several metres high; fields are rough, the road is smooth and a little raised."""
    shape = (distance.shape[0], distance.shape[1])
    heights = rng.uniform(2.0, 3.0) * smooth_noise(rng, shape, 50.0 / _CELL_M)
    heights += 0.35 * smooth_noise(rng, shape, 24.0 / _CELL_M)
    off_road = np.clip((distance - _ROAD_HALF_M) / 1.5, 0.0, 1.0)
    heights += (0.1 + 0.9 * off_road) * 0.05 * smooth_noise(rng, shape, 2.0 / _CELL_M)
    heights += off_road * 0.035 * smooth_noise(rng, shape, 0.7) - 0.2 * off_road
    return HeightField(low, _CELL_M, heights)


def _parcels(rng: np.random.Generator, distance: FloatArray) -> FloatArray:
    """Mean height (X, Y) of what grows: stubble, meadow or crops in parcels, a mown strip along the road."""
    shape = (distance.shape[0], distance.shape[1])
    kind = np.digitize(smooth_noise(rng, shape, 40.0 / _CELL_M), [-0.4, 0.5])
    return np.where(distance < _ROAD_HALF_M + 2.0, 0.12, np.array([0.06, 0.22, 0.4])[kind])
