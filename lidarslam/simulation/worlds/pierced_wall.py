"""Walls with holes in them, for doors, windows and gates."""

from dataclasses import dataclass

from lidarslam.simulation.worlds.interior import Spot


@dataclass(frozen=True)
class Opening:
    """A hole in a wall: limits along it and in height."""

    x: tuple[float, float]
    z: tuple[float, float]


def pierced_wall(
    spot: Spot, x: tuple[float, float], y: tuple[float, float], height: float, openings: list[Opening]
) -> None:
    """A wall with holes: whole between them, and what is left below and above them."""
    at = x[0]
    for hole in sorted(openings, key=lambda o: o.x):
        spot.box((at, hole.x[0]), y, (0.0, height))
        if hole.z[0] > 0.0:
            spot.box(hole.x, y, (0.0, hole.z[0]))
        spot.box(hole.x, y, (hole.z[1], height))
        at = hole.x[1]
    spot.box((at, x[1]), y, (0.0, height))
