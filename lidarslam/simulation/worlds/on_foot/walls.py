"""Walls with closed windows and open doorways."""

from lidarslam.simulation.worlds.building import Limits, Opening, Spot

WALL_M = 0.2
_PANE_M, _BAR_M = 0.05, 0.03


def glazed_wall(
    spot: Spot, x: Limits, height: float, windows: list[Opening], doorways: tuple[Opening, ...] = ()
) -> None:
    """A wall whose inner face is at y = 0 of the spot; windows are recesses closed by a pane with an upright bar."""
    spot.pierced_wall(x, (-WALL_M, 0.0), height, [*windows, *doorways])
    for window in windows:
        middle = 0.5 * (window.x[0] + window.x[1])
        spot.box(window.x, (-WALL_M, -WALL_M + _PANE_M), window.z)
        spot.box((middle - _BAR_M, middle + _BAR_M), (-WALL_M, -WALL_M + 2.0 * _PANE_M), window.z)
