"""The town: a drive through every street in both directions, and nothing in its way."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.mesh import Caster
from lidarslam.simulation.route_motion import motion_along_route
from lidarslam.simulation.world import World
from lidarslam.simulation.worlds import town
from lidarslam.simulation.worlds.paths import subdivide_loop

SEEDS = range(2)


def plan(seed: int) -> tuple[FloatArray, list[tuple[int, int]], list[int]]:
    rng = np.random.default_rng(seed)
    nodes, streets = town.draw_network(rng)
    return nodes, streets, town.draw_tour(rng, len(nodes), streets)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_lap_takes_every_street_once_in_either_direction(seed):
    nodes, streets, tour = plan(seed)
    driven = Counter(pairwise([*tour, tour[0]]))
    assert driven == Counter([*streets, *(street[::-1] for street in streets)])
    assert not any(before == after for before, after in zip(tour, [*tour[2:], *tour[:2]], strict=True))  # no turn round
    steps = nodes[tour] - np.roll(nodes[tour], 1, axis=0)
    assert 9_000.0 < np.linalg.norm(steps, axis=1).sum() < 13_000.0


@pytest.mark.parametrize("seed", SEEDS)
def test_streets_meet_at_corners_that_a_car_can_take(seed):
    nodes, streets, _ = plan(seed)
    assert len(streets) < 60
    assert np.bincount(np.ravel(streets)).min() >= 2
    for node in range(len(nodes)):
        ends = [nodes[b if a == node else a] - nodes[node] for a, b in streets if node in (a, b)]
        angles = np.sort([np.arctan2(y, x) for x, y in ends])
        assert np.diff([*angles, angles[0] + 2.0 * np.pi]).min() > np.deg2rad(40.0)


@pytest.fixture(scope="module")
def small() -> World:
    """A town of four blocks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(town, "_ROWS", 3)
        patch.setattr(town, "_LEFT_OUT", 2)
        return town.town(0)


@pytest.mark.slow
def test_nothing_stands_in_the_way_of_the_car(small):
    lane = subdivide_loop(small.route.waypoints, 1.0)
    clear = Caster(small).distances(lane + np.array([0.0, 0.0, town.FREE_SIDE_M]))
    assert clear.min() > town.FREE_SIDE_M - 0.6  # over the ground's own unevenness
    assert len(small.boxes) > 1000
    assert (small.cylinders.radii == 0.33).sum() > 20  # wheels
    assert small.movers


@pytest.mark.slow
def test_a_car_goes_round_and_round(small):
    motion = motion_along_route("car-fast", small, 0)
    way = np.linalg.norm(np.diff(motion.base[:, :2], axis=0), axis=1)
    assert way.max() * (len(way) / motion.duration_s) < 14.5
    start, again = motion.pose_at(np.array([0.0, motion.duration_s]))
    assert np.allclose(start, again, atol=0.02)  # but for its suspension
