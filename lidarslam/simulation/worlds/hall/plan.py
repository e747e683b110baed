"""Measures of an industrial hall: two decks, the four ramps that lead up to them and down again, and the way around.

deck 2 |<-- ramp B, up ----| deck 1        y = depth
(2h)   |--- ramp A, up --->| (h)
  |
ramp C, down      ground: aisles, machines, racks
  |
landing (h) --- ramp D, down ---> ground   y = 0
"""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Route

STRIP_M = 9.0
DECK_2_WIDTH_M = 10.0
LANDING_WIDTH_M = 7.0
LANE_M = 3.0
# From a wall to the middle of the lane along it, and to the middle of the next lane.
LANE_AT_M, NEXT_LANE_AT_M = 2.5, 7.0
FREE_SIDE_M, FREE_HEIGHT_M = 0.9, 2.2


@dataclass(frozen=True)
class Ramp:
    """A ramp `LANE_M` wide, by the middle of its upper face's ends (3,); the lower end first."""

    foot: FloatArray
    head: FloatArray


@dataclass(frozen=True)
class Deck:
    """A level floor on columns.

    Attributes:
        low, high: (2,) corners.
        z: of its upper face.
        railings: (K, 2, 2) from and to, its open edges.
    """

    low: FloatArray
    high: FloatArray
    z: float
    railings: FloatArray


@dataclass(frozen=True)
class HallPlan:
    """What is where; the hall fills x from 0 to `width`, y from 0 to `depth`.

    Attributes:
        width, depth, height: inside.
        aisle_y: of the two aisles across the ground floor.
        turn_x: where the way changes from one aisle to the other.
        ramps, decks: as in the picture above, A to D, and deck 1, deck 2, landing.
        route: all the way around.
    """

    width: float
    depth: float
    height: float
    aisle_y: tuple[float, float]
    turn_x: float
    ramps: tuple[Ramp, ...]
    decks: tuple[Deck, ...]
    route: Route


def draw_hall(rng: np.random.Generator) -> HallPlan:
    """A hall no two seeds share, its route 230 to 300 m long, its ramps at most 11.7 % steep."""
    width, depth, height = rng.uniform(58.0, 64.0), rng.uniform(40.0, 43.0), rng.uniform(11.5, 13.0)
    run = rng.uniform(25.0, depth - STRIP_M - 4.8)
    rise = run * rng.uniform(0.106, 0.117)
    near, next_lane, far = LANE_AT_M, depth - NEXT_LANE_AT_M, depth - LANE_AT_M
    deck_1_x, landing_y = DECK_2_WIDTH_M + run, depth - STRIP_M - run
    ramps = (
        _ramp((DECK_2_WIDTH_M, next_lane, 0.0), (deck_1_x, next_lane, rise)),
        _ramp((deck_1_x, far, rise), (DECK_2_WIDTH_M, far, 2.0 * rise)),
        _ramp((near, landing_y, rise), (near, depth - STRIP_M, 2.0 * rise)),
        _ramp((LANDING_WIDTH_M + run, near, 0.0), (LANDING_WIDTH_M, near, rise)),
    )
    aisles = (rng.uniform(0.32, 0.4) * depth, depth - rng.uniform(12.5, 14.0))
    turn_x, deck_turn_x = rng.uniform(0.3, 0.55) * width, deck_1_x + rng.uniform(7.0, 12.0)
    lower = [(width - 4.0, near), (width - 4.0, aisles[0]), (turn_x, aisles[0]), (turn_x, aisles[1])]
    lower += [(6.5, aisles[1]), (6.5, next_lane)]
    waypoints = [
        *[np.array([x, y, 0.0]) for x, y in lower],
        ramps[0].foot,
        ramps[0].head,
        np.array([deck_turn_x, next_lane, rise]),
        np.array([deck_turn_x, far, rise]),
        ramps[1].foot,
        ramps[1].head,
        np.array([near, far, 2.0 * rise]),
        ramps[2].head,
        ramps[2].foot,
        np.array([near, near, rise]),
        ramps[3].head,
        ramps[3].foot,
    ]
    route = Route(np.stack(waypoints), 0.8, FREE_SIDE_M, FREE_HEIGHT_M, 2.0)
    decks = _decks(width, depth, rise, deck_1_x, landing_y)
    return HallPlan(width, depth, height, aisles, turn_x, ramps, decks, route)


def _ramp(foot: tuple[float, float, float], head: tuple[float, float, float]) -> Ramp:
    return Ramp(np.array(foot), np.array(head))


def _decks(width: float, depth: float, rise: float, deck_1_x: float, landing_y: float) -> tuple[Deck, ...]:
    """Deck 1, deck 2 and the landing, with railings wherever no ramp joins and no wall is."""
    front, half = depth - STRIP_M, 0.5 * LANE_M
    far, second, near = depth - LANE_AT_M, depth - NEXT_LANE_AT_M, LANE_AT_M
    west_of_1 = [(front, second - half), (second + half, far - half), (far + half, depth)]
    east_of_2 = [(front, far - half), (far + half, depth)]
    railings_1 = [((deck_1_x, a), (deck_1_x, b)) for a, b in west_of_1]
    # A gap for the stairs.
    railings_1 += [((deck_1_x, front), (width - 3.2, front)), ((width - 1.8, front), (width, front))]
    railings_2 = [((DECK_2_WIDTH_M, a), (DECK_2_WIDTH_M, b)) for a, b in east_of_2]
    railings_2 += [((0.0, front), (near - half, front)), ((near + half, front), (DECK_2_WIDTH_M, front))]
    railings_3 = [
        ((0.0, landing_y), (near - half, landing_y)),
        ((near + half, landing_y), (LANDING_WIDTH_M, landing_y)),
    ]
    railings_3 += [((LANDING_WIDTH_M, 0.0), (LANDING_WIDTH_M, near - half))]
    railings_3 += [((LANDING_WIDTH_M, near + half), (LANDING_WIDTH_M, landing_y))]
    return (
        Deck(np.array([deck_1_x, front]), np.array([width, depth]), rise, np.array(railings_1)),
        Deck(np.array([0.0, front]), np.array([DECK_2_WIDTH_M, depth]), 2.0 * rise, np.array(railings_2)),
        Deck(np.zeros(2), np.array([LANDING_WIDTH_M, landing_y]), rise, np.array(railings_3)),
    )
