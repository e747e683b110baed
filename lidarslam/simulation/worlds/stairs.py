"""A stairwell: equal flights with half landings round a narrow shaft, reached from a lobby on the ground floor.

half landing  x = run     ______________
                         |  A up | down B|
              x = 0      |_______|_______|
storey landing           |_______________|
                         |     lobby     |   ground floor only
"""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Route, World
from lidarslam.simulation.worlds import interior
from lidarslam.simulation.worlds.building import OUTER_WALL_M, Builder, Opening, Room
from lidarslam.simulation.worlds.interior import Furnisher, draw_railing
from lidarslam.simulation.worlds.paths import Clearance

RISE_M, TREAD_M = 0.17, 0.28
_SLAB_M, _RAIL_ASIDE_M = 0.2, 0.06
_TURN_M = 1.3  # from the lobby's end to where the route turns
_FREE_SIDE_M, _FREE_HEIGHT_M, _SPEED_LIMIT_MPS = 0.4, 2.1, 0.8


@dataclass(frozen=True)
class StairPlan:
    """Measures of a stairwell; it fills x from -landing to run + landing, y from 0 to `across`."""

    storeys: int  # climbed
    steps: int  # of a flight
    width: float  # of a flight
    shaft: float  # between the flights
    landing: float  # depth
    lobby: float  # depth

    @property
    def run(self) -> float:
        """Length of a flight from its lowest riser to its highest."""
        return (self.steps - 1) * TREAD_M

    @property
    def climb(self) -> float:
        """Height of a flight."""
        return self.steps * RISE_M

    @property
    def across(self) -> float:
        """Width of the stairwell."""
        return 2.0 * self.width + self.shaft

    def flight(self, builder: Builder, number: int) -> Builder:
        """The frame of a flight, x up it from the middle of its lowest riser; the shaft is on its left."""
        back = bool(number % 2)
        x, y = (self.run, self.across - 0.5 * self.width) if back else (0.0, 0.5 * self.width)
        return builder.shifted(x, y, number * self.climb, yaw=np.pi * back)


def stairs(seed: int) -> World:
    """The stairwell of that seed: four to six storeys up and down again; the ground floor is at z = 0."""
    rng = np.random.default_rng(seed)
    storeys, steps = int(rng.integers(4, 7)), int(rng.integers(9, 11))
    width, shaft, landing = rng.uniform(1.25, 1.4), rng.uniform(0.2, 0.6), rng.uniform(1.35, 1.6)
    plan = StairPlan(storeys, steps, width, shaft, landing, rng.uniform(4.0, 6.0))
    builder, route = Builder(), _route(plan)
    for number in range(2 * plan.storeys):
        flight, half = plan.flight(builder, number), 0.5 * plan.width
        for k in range(1, plan.steps):
            flight.block(((k - 1) * TREAD_M, k * TREAD_M), (-half, half), ((k - 1) * RISE_M - 0.1, k * RISE_M))
        slab = (plan.climb - _SLAB_M, plan.climb)
        flight.block((plan.run, plan.run + plan.landing), (-half, plan.across - half), slab)
        rail = half - _RAIL_ASIDE_M
        draw_railing(flight.point(0.0, rail, RISE_M), flight.point(plan.run, rail, plan.climb), builder)
    top = plan.flight(builder, 2 * plan.storeys)
    draw_railing(top.point(0.0, -0.5 * plan.width), top.point(0.0, 0.5 * plan.width + plan.shaft), builder)
    _draw_shell(plan, builder, Clearance(route), rng)
    return World("stairs", seed, route, *builder.solids)


def _route(plan: StairPlan) -> Route:
    """From the lobby to the uppermost landing and back; on a flight along the mean line of its steps."""
    nowhere = Builder()
    near, far = 0.5 * plan.width, plan.across - 0.5 * plan.width
    start = -plan.landing - plan.lobby + _TURN_M
    up: list[FloatArray] = []
    for number in range(2 * plan.storeys):
        flight = plan.flight(nowhere, number)
        foot, head = -0.5 * TREAD_M, plan.run + 0.5 * TREAD_M
        turn = plan.run + 0.5 * plan.landing
        up += [flight.point(foot, 0.0, 0.0)]
        up += [flight.point(x, y, plan.climb) for x, y in ((head, 0.0), (turn, 0.0), (turn, far - near))]
    lobby = np.array([[-0.5 * plan.landing, near, 0.0], [-0.5 * plan.landing, far, 0.0], [start, far, 0.0]])
    waypoints = np.concatenate([[[start, near, 0.0]], up, up[-2::-1], lobby])
    return Route(waypoints, 0.3, _FREE_SIDE_M, _FREE_HEIGHT_M, _SPEED_LIMIT_MPS)


def _draw_shell(plan: StairPlan, builder: Builder, clearance: Clearance, rng: np.random.Generator) -> None:
    """Walls, floor and ceilings; on every storey the same window opposite the same door, furniture in the lobby."""
    storey, low, high = 2.0 * plan.climb, -plan.landing - plan.lobby, plan.run + plan.landing
    height = (plan.storeys + 1) * storey
    lobby_end = -plan.landing - OUTER_WALL_M
    for x, z in ((high, -_SLAB_M), (high, height), (lobby_end, storey - _SLAB_M)):
        builder.block((low, x), (0.0, plan.across), (z, z + _SLAB_M))
    for y in (-OUTER_WALL_M, plan.across):
        builder.block((low, high), (y, y + OUTER_WALL_M), (-_SLAB_M, height + _SLAB_M))
    builder.block((low - OUTER_WALL_M, low), (-OUTER_WALL_M, plan.across + OUTER_WALL_M), (-_SLAB_M, storey))
    front = builder.shifted(-plan.landing, plan.across, yaw=-0.5 * np.pi)
    back = builder.shifted(high, 0.0, yaw=0.5 * np.pi)
    middle, wide = 0.5 * plan.across, (0.0, plan.across)
    window = Opening((middle - 0.7, middle + 0.7), (plan.climb + 0.9, plan.climb + 1.5))
    door = Opening((middle - 0.5, middle + 0.5), (0.0, 2.1))
    for level in range(plan.storeys + 1):
        back.shifted(0.0, 0.0, level * storey).glazed_wall(wide, storey, [window])
        if level:  # the ground floor is open to the lobby
            front.shifted(0.0, 0.0, level * storey).glazed_wall(wide, storey, [door])
    put, lobby = Furnisher(builder, clearance, rng), Room(np.array([low, 0.0]), np.array([-plan.landing, plan.across]))
    clearance.take(np.array([-plan.landing - 1.0, 0.0, 0.0]), np.array([high, plan.across, height]))
    for _ in range(2):
        put.place(lobby, put.drawn(((0.6, 1.2), (0.3, 0.5), (0.9, 1.8))), interior.cabinet)
        put.place(lobby, put.drawn(((0.6, 1.5), 0.05, 1.0)), interior.board, z=1.0)
