"""Bird's-eye grids of scans: cells in the sensor's xy plane, in which a translation is a shift.

The channels of a cell separate upright surfaces from the ground, whose rings move with the sensor: number of points,
uprightness and azimuth of their normals, and heights.
"""

import math

import numpy as np

from lidarslam.core.compiled import compiled
from lidarslam.odometry.images.projection import Floats

CELLS = 96
"""Cells along x and along y, the sensor between the two in the middle."""
CELL_M = 1.0
CHANNELS = 8
"""Values of a cell."""
MOST_CELLS = 18
"""Largest shift that is looked for, in cells along each axis: 18 m."""
SHIFTS = 2 * MOST_CELLS + 1
"""Shifts along x and along y, in cells, that are scored."""

REACH_M = 40.0 * CELL_M
"""Points farther away are left out: the largest shifts would wrap them around the border."""
DENSITY_M = 10.0
"""Range at which a point counts once for the density; a surface twice as far away returns a quarter as many."""


def bird_eye(points: Floats, normals: Floats, heading: float) -> Floats:
    """Grid (CHANNELS, CELLS, CELLS) of one scan, rows along y and columns along x.

    Args:
        points, normals: (3, H, W) range image in metres, zero where empty; unit normals, zero where there is none.
        heading: angle by which the scan is turned about z first, radians.
    """
    grid = np.zeros((CELLS, CELLS, CHANNELS), dtype=np.float32)
    flat = [np.ascontiguousarray(part, dtype=np.float32).reshape(3, -1) for part in (points, normals)]
    _accumulate(flat[0], flat[1], math.cos(heading), math.sin(heading), grid)
    return np.ascontiguousarray(np.moveaxis(grid, -1, 0))


@compiled
def _accumulate(points: Floats, normals: Floats, c: float, s: float, grid: Floats) -> None:
    """Write the grid (CELLS, CELLS, CHANNELS), zero before: sums first, then the network's input."""
    for i in range(points.shape[1]):
        px, py, z = points[0, i], points[1, i], points[2, i]
        squared = px * px + py * py
        if squared == 0.0 or squared > REACH_M * REACH_M:
            continue
        column = math.floor((c * px - s * py) / CELL_M) + CELLS // 2
        row = math.floor((s * px + c * py) / CELL_M) + CELLS // 2
        cell = grid[row, column]
        if cell[0] == 0.0:
            cell[6], cell[7] = z, z
        cell[0] += 1.0
        cell[1] += (squared + z * z) / (DENSITY_M * DENSITY_M)
        u, v = normals[0, i], normals[1, i]
        x, y = c * u - s * v, s * u + c * v
        # Twice the azimuth of a normal: a wall is the same from both sides.
        cell[2] += u * u + v * v
        cell[3] += x * x - y * y
        cell[4] += 2.0 * x * y
        cell[5] += z
        cell[6], cell[7] = min(cell[6], z), max(cell[7], z)
    for row in range(CELLS):
        for column in range(CELLS):
            cell = grid[row, column]
            count = cell[0]
            if count == 0.0:
                continue
            upright = cell[2]
            amount = math.log1p(upright)
            facing = amount / max(upright, 1e-6)
            mean, low, high = cell[5] / count, cell[6], cell[7]
            cell[0], cell[1], cell[2] = 0.5 * math.log1p(count), 0.5 * math.log1p(cell[1]), amount
            cell[3], cell[4] = facing * cell[3], facing * cell[4]
            cell[5], cell[6], cell[7] = math.tanh(0.4 * mean), math.tanh(0.4 * high), math.tanh(high - low)
