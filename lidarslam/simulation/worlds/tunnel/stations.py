"""Places along a tunnel's loop, and the distance of its walls from them."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.worlds.building import UP
from lidarslam.simulation.worlds.tunnel.plan import SPACING_M, Gallery, loop_lefts
from lidarslam.simulation.worlds.tunnel.rock import Rock

_STATION_M = 1.0


@dataclass(frozen=True)
class Stations:
    """Places along the loop, `_STATION_M` apart."""

    floor: FloatArray  # (N, 3) on the ground in the middle
    left: FloatArray  # (N, 2) unit vectors to the left
    half_widths: FloatArray  # (N,) as planned
    rock: Rock  # around them
    free_side_m: float  # to be kept free of fittings, as is the height
    free_height_m: float

    def __len__(self) -> int:
        return len(self.floor)

    def at(self, k: int, aside: float, up: float) -> FloatArray:
        """A point (3,) that far to the left of station k (counted round and round) and above its floor."""
        k %= len(self)
        return np.append(self.floor[k, :2] + aside * self.left[k], self.floor[k, 2] + up)

    def on_ground(self, k: int, aside: float) -> FloatArray:
        """A point (3,) on the ground that far to the left of station k."""
        point = self.at(k, aside, 0.0)
        point[2] = float(self.rock.ground.height_at(point[None, :2])[0])
        return point

    def is_beside(self, point: FloatArray, reach: float) -> bool:
        """Whether what reaches that far around a point (3,) keeps out of the free space along the way."""
        nearest = float(np.linalg.norm(self.floor[:, :2] - point[:2], axis=1).min())
        # Between two stations the way is up to this much closer.
        return nearest > float(np.hypot(self.free_side_m + reach + 0.05, 0.5 * _STATION_M))

    def wall(self, side: float, up: float) -> FloatArray:
        """(N,) distance to the wall on one side (+1 left, -1 right), at a height above the floor."""
        return self.rock.reach(self.floor + up * UP, side * self.left)


def place_stations(loop: Gallery, rock: Rock, free_side_m: float, free_height_m: float) -> Stations:
    """Stations along the loop, on the carved ground."""
    every = round(_STATION_M / SPACING_M)
    line, left = loop.line[::every].copy(), loop_lefts(loop.line)[::every]
    line[:, 2] = rock.ground.height_at(line[:, :2])
    return Stations(line, left, loop.half_widths[::every], rock, free_side_m, free_height_m)
