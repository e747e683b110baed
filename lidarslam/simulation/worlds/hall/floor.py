"""Racks, machines, goods and fork-lifts on the floors of an industrial hall."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import Mover
from lidarslam.simulation.worlds.building import Builder, Spot
from lidarslam.simulation.worlds.clearance import Clearance
from lidarslam.simulation.worlds.hall import equipment
from lidarslam.simulation.worlds.hall.equipment import MACHINES, cabin, drums, loaded_pallet
from lidarslam.simulation.worlds.hall.plan import HallPlan
from lidarslam.simulation.worlds.interior import Piece, Size, crate

_GAP_M = 0.5


@dataclass(frozen=True)
class Yard:
    """Puts things down where there is room for them."""

    builder: Builder
    clearance: Clearance
    rng: np.random.Generator

    def put(self, at: FloatArray, size: Size, turned: bool, piece: Piece) -> bool:
        """Draw a piece of that length, width and height with its middle at (3,); whether there was room for it."""
        reach = 0.5 * np.array([size[1], size[0]] if turned else [size[0], size[1]])
        low = np.append(at[:2] - reach, at[2] + 0.01)
        if not self.clearance.claim(low, np.append(at[:2] + reach, at[2] + size[2]), _GAP_M):
            return False
        spot = Spot(self.builder, at, 0.5 * np.pi * turned + np.pi * float(self.rng.integers(2)))
        piece(spot, size, self.rng)
        return True


def fill_floors(plan: HallPlan, yard: Yard) -> tuple[Mover, ...]:
    """Fork-lifts' rounds first, then racks in rows, then machines, then goods; the fork-lifts."""
    movers = _send_forklifts(plan, yard)
    _set_racks(plan, yard)
    _set_machines(plan, yard)
    for deck in plan.decks[:2]:
        _fill(yard, deck.low + 0.4, deck.high - 0.4, deck.z, 40)
    _fill(yard, np.full(2, 0.6), np.array([plan.width, plan.depth]) - 0.6, 0.0, 300)
    return movers


def _send_forklifts(plan: HallPlan, yard: Yard) -> tuple[Mover, ...]:
    """Two or three fork-lifts that go around in rectangles off the way."""
    rng = yard.rng
    movers: list[Mover] = []
    wanted = int(rng.integers(2, 4))
    for attempt in range(400):
        if len(movers) == wanted:
            break
        # Where a large round does not fit, a small one may.
        shrink = 1.0 - 0.7 * attempt / 400
        size = shrink * rng.uniform([6.0, 3.0], [14.0, 6.0])[:: int(rng.choice([-1, 1]))]
        low = rng.uniform([3.0, 5.0], np.array([plan.width - 3.0, plan.depth - 11.0]) - size)
        high = low + size
        # Turning on the spot, its forks sweep 2.1 m.
        if not yard.clearance.claim(np.append(low - 2.1, 0.01), np.append(high + 2.1, 2.5)):
            continue
        corners = np.array([[*low, 0.0], [high[0], low[1], 0.0], [*high, 0.0], [low[0], high[1], 0.0]])
        corners = corners[:: int(rng.choice([-1, 1]))]
        movers.append(
            Mover(equipment.forklift(rng), corners, rng.uniform(0.8, 1.8), rng.uniform(0.0, float(size.sum())))
        )
    return tuple(movers)


def _set_racks(plan: HallPlan, yard: Yard) -> None:
    """Rows of racks between the aisles, to the right of where the way turns."""
    rng = yard.rng
    spacing, levels = rng.uniform(3.2, 4.0), int(rng.integers(3, 5))
    for y in np.arange(plan.aisle_y[0] + 2.2, plan.aisle_y[1] + 1.5, spacing):
        x = plan.turn_x + 3.0
        while x < plan.width - 5.0:
            size = (int(rng.integers(1, 4)) * equipment.BAY_M + 0.1, equipment.RACK_DEPTH_M + 0.2, 1.6 * levels)
            middle = np.array([x + 0.5 * size[0], y, 0.0])
            fits = middle[0] + 0.5 * size[0] < plan.width - 1.0
            x += size[0] + rng.choice([0.55, 2.0]) if fits and yard.put(middle, size, False, equipment.rack) else 0.5


def _set_machines(plan: HallPlan, yard: Yard) -> None:
    """Machines in rows, kinds by turns."""
    rng = yard.rng
    xs, ys = np.arange(3.0, plan.width - 2.0, 3.6), np.arange(6.0, plan.depth - 10.0, 3.2)
    places = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    for k, place in enumerate(rng.permutation(places)):
        machine, least, most = MACHINES[k % len(MACHINES)]
        x, y, z = rng.uniform(least, most)
        middle = np.append(place + rng.uniform(-0.3, 0.3, 2), 0.0)
        reach = 0.5 * max(x, y) + 0.5
        if (middle[:2] > reach).all() and (middle[:2] < [plan.width - reach, plan.depth - reach]).all():
            yard.put(middle, (x, y, z), bool(rng.random() < 0.3), machine)


def _fill(yard: Yard, low: FloatArray, high: FloatArray, z: float, tries: int) -> None:
    """A cabin, and pallets, drums and crates wherever there is room between two corners (2,)."""
    rng = yard.rng
    for k in range(tries):
        piece: Piece = cabin if k == 0 else (loaded_pallet, drums, crate)[int(rng.integers(3))]
        if piece is loaded_pallet:
            size: Size = (1.25, 0.95, 1.3)
        elif piece is drums:
            size = (0.62 * rng.integers(2, 5), 1.25, 1.8)
        elif piece is crate:
            size = (rng.uniform(0.5, 1.4), rng.uniform(0.5, 1.4), rng.uniform(0.5, 1.4))
        else:
            size = (rng.uniform(2.6, 4.0), rng.uniform(2.2, 3.0), 2.5)
        reach = 0.5 * max(size[:2])
        middle = np.append(rng.uniform(low + reach, high - reach), z)
        yard.put(middle, size, bool(rng.random() < 0.5), piece)
