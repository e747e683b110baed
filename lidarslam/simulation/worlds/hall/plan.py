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

_STRIP_M = 9.0
_DECK_2_WIDTH_M = 10.0
_LANDING_WIDTH_M = 7.0
LANE_M = 3.0
# From a wall to the middle of the lane along it, and to the middle of the next lane.
_LANE_AT_M, _NEXT_LANE_AT_M = 2.5, 7.0
_FREE_SIDE_M, _FREE_HEIGHT_M = 0.9, 2.2


@dataclass(frozen=True)
class Ramp:
    """A ramp `LANE_M` wide, by the middle of its upper face's ends (3,)."""

    foot: FloatArray
    head: FloatArray


@dataclass(frozen=True)
class Deck:
    """A level floor on columns."""

    low: FloatArray  # (2,) corners
    high: FloatArray
    z: float  # of its upper face
    railings: FloatArray  # (K, 2, 2) from and to, its open edges


@dataclass(frozen=True)
class HallPlan:
    """The hall; it fills x from 0 to `width`, y from 0 to `depth`."""

    width: float
    depth: float
    height: float  # inside
    aisle_y: tuple[float, float]  # of the two aisles across the ground floor
    turn_x: float  # where the way changes from one aisle to the other
    ramps: tuple[Ramp, ...]  # A to D in the picture above
    decks: tuple[Deck, ...]  # deck 1, deck 2, landing
    route: Route


def draw_hall(rng: np.random.Generator) -> HallPlan:
    """A hall no two seeds share, its route 230 to 300 m long, its ramps at most 11.7 % steep."""
    width, depth, height = rng.uniform(58.0, 64.0), rng.uniform(40.0, 43.0), rng.uniform(11.5, 13.0)
    run = rng.uniform(25.0, depth - _STRIP_M - 4.8)
    rise = run * rng.uniform(0.106, 0.117)
    near, next_lane, far = _LANE_AT_M, depth - _NEXT_LANE_AT_M, depth - _LANE_AT_M
    deck_1_x, landing_y = _DECK_2_WIDTH_M + run, depth - _STRIP_M - run
    ramp_a = [(_DECK_2_WIDTH_M, next_lane, 0.0), (deck_1_x, next_lane, rise)]
    ramp_b = [(deck_1_x, far, rise), (_DECK_2_WIDTH_M, far, 2.0 * rise)]
    ramp_c = [(near, landing_y, rise), (near, depth - _STRIP_M, 2.0 * rise)]
    ramp_d = [(_LANDING_WIDTH_M + run, near, 0.0), (_LANDING_WIDTH_M, near, rise)]
    aisles = (rng.uniform(0.32, 0.4) * depth, depth - rng.uniform(12.5, 14.0))
    turn_x, deck_turn_x = rng.uniform(0.3, 0.55) * width, deck_1_x + rng.uniform(7.0, 12.0)
    waypoints = [
        *((width - 4.0, near, 0.0), (width - 4.0, aisles[0], 0.0), (turn_x, aisles[0], 0.0)),
        *((turn_x, aisles[1], 0.0), (6.5, aisles[1], 0.0), (6.5, next_lane, 0.0)),
        *(*ramp_a, (deck_turn_x, next_lane, rise), (deck_turn_x, far, rise)),
        *(*ramp_b, (near, far, 2.0 * rise), *ramp_c[::-1], (near, near, rise), *ramp_d[::-1]),
    ]
    route = Route(np.array(waypoints), 0.8, _FREE_SIDE_M, _FREE_HEIGHT_M, 2.0)
    ramps = tuple(Ramp(np.array(foot), np.array(head)) for foot, head in (ramp_a, ramp_b, ramp_c, ramp_d))
    decks = _decks(width, depth, rise, deck_1_x, landing_y)
    return HallPlan(width, depth, height, aisles, turn_x, ramps, decks, route)


def _decks(width: float, depth: float, rise: float, deck_1_x: float, landing_y: float) -> tuple[Deck, ...]:
    """Deck 1, deck 2 and the landing, with railings wherever no ramp joins and no wall is."""
    front, half = depth - _STRIP_M, 0.5 * LANE_M
    far, second, near = depth - _LANE_AT_M, depth - _NEXT_LANE_AT_M, _LANE_AT_M

    def along_y(x: float, *spans: tuple[float, float]) -> list[list[tuple[float, float]]]:
        return [[(x, a), (x, b)] for a, b in spans]

    def along_x(y: float, *spans: tuple[float, float]) -> list[list[tuple[float, float]]]:
        return [[(a, y), (b, y)] for a, b in spans]

    railings_1 = along_y(deck_1_x, (front, second - half), (second + half, far - half), (far + half, depth))
    railings_1 += along_x(front, (deck_1_x, width - 3.2), (width - 1.8, width))  # a gap for the stairs
    railings_2 = along_y(_DECK_2_WIDTH_M, (front, far - half), (far + half, depth))
    railings_2 += along_x(front, (0.0, near - half), (near + half, _DECK_2_WIDTH_M))
    railings_3 = along_x(landing_y, (0.0, near - half), (near + half, _LANDING_WIDTH_M))
    railings_3 += along_y(_LANDING_WIDTH_M, (0.0, near - half), (near + half, landing_y))
    return (
        Deck(np.array([deck_1_x, front]), np.array([width, depth]), rise, np.array(railings_1)),
        Deck(np.array([0.0, front]), np.array([_DECK_2_WIDTH_M, depth]), 2.0 * rise, np.array(railings_2)),
        Deck(np.zeros(2), np.array([_LANDING_WIDTH_M, landing_y]), rise, np.array(railings_3)),
    )
