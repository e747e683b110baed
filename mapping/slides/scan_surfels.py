"""Surfels of one scan, and a Hough vote for the shift between two scans along a direction."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.state.stateful import Shape
from lidarslam.mapping.slides.kernels import COLUMNS, ROWS, draw_indices, vote, write_planes

_MIN_RANGE_M = 1.0
_FEWEST_NEIGHBOURS = 5
# Largest ratio of the variances of thickness and width, least ratio of those of width and length, and the largest
# thickness that noise explains.
_THINNEST_SHARE, _LINE_SHARE = 0.02, 0.05
_NOISE_M, _NOISE_OF_RANGE = 0.02, 0.005
# Surfels face along a direction within this cosine. Fewer have no evidence; more take time without any gain.
_FACING = 0.6
_FEWEST_FACING, _MOST_FACING = 10, 800
# Edge of a block on the ground, the width of a vehicle, and the largest number of votes of its surfels.
_BLOCK_M, _MOST_OF_BLOCK = 2.0, 3.0
# Width of a vote, distance between shifts, and the largest shift.
_GATE_M, BIN_M, _FARTHEST_M = 0.15, 0.1, 32.0


@dataclass(frozen=True, eq=False)
class Surfels:
    """Small planes of a scan, in its LiDAR frame: points (N, 3), normals (N, 3) towards the sensor, radii (N,)."""

    points: Annotated[FloatArray, Shape(None, 3)]
    normals: Annotated[FloatArray, Shape(None, 3)]
    radii: Annotated[FloatArray, Shape(None)]

    def __post_init__(self) -> None:
        if not len(self.points) == len(self.normals) == len(self.radii):
            raise ValueError("points, normals and radii differ in length")

    @classmethod
    def of(cls, points: FloatArray) -> "Surfels":
        """Surfels of motion-compensated points (N, 3), at most one for each degree of azimuth and elevation."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        image = np.empty((ROWS, COLUMNS), dtype=np.int64)
        draw_indices(points, _MIN_RANGE_M, image)
        pixels = np.argwhere(image >= 0)
        means, normals, variances = np.empty((3, len(pixels), 3))
        counts = np.empty(len(pixels), dtype=np.int64)
        write_planes(points, image, pixels, means, normals, variances, counts)
        normals[np.einsum("ij,ij->i", normals, means) > 0.0] *= -1.0
        noise_m = _NOISE_M + _NOISE_OF_RANGE * np.linalg.norm(means, axis=1)
        flat = (variances[:, 0] < _THINNEST_SHARE * variances[:, 1]) & (variances[:, 0] < noise_m**2)
        flat &= (variances[:, 1] > _LINE_SHARE * variances[:, 2]) & (counts >= _FEWEST_NEIGHBOURS)
        return cls(means[flat], normals[flat], 2.0 * np.sqrt(variances[flat, 2]))

    def facing(self, direction: FloatArray) -> "Surfels":
        """The surfels that face along a direction (3,), either way."""
        chosen = np.abs(self.normals @ direction) > _FACING
        return Surfels(self.points[chosen], self.normals[chosen], self.radii[chosen])

    def moved(self, T: FloatArray) -> "Surfels":
        """The surfels in another frame, by a transform (4, 4)."""
        return Surfels(transform_points(T, self.points), self.normals @ T[:3, :3].T, self.radii)


def shift_profile(
    first: Surfels, second: Surfels, T_first_second: FloatArray, direction: FloatArray
) -> FloatArray | None:
    """Votes (S,) for shifts of the second scan along a direction, every 0.1 m, with the shift of zero in the middle.

    Args:
        first, second: surfels of two scans, each in its frame.
        T_first_second: (4, 4) relative pose under test.
        direction: (3,) unit vector in the first's frame.

    Returns:
        None where too few surfels face along the direction.
    """
    held, moved = first.facing(direction), second.moved(T_first_second).facing(direction)
    if min(len(held.points), len(moved.points)) < _FEWEST_FACING:
        return None
    stride = -(-len(moved.points) // _MOST_FACING)
    points, normals = moved.points[::stride], moved.normals[::stride]
    cells, block = np.unique(np.floor(points[:, :2] / _BLOCK_M), axis=0, return_inverse=True)
    order = np.argsort(block.ravel(), kind="stable")
    votes = np.empty((len(cells), 2 * round(_FARTHEST_M / BIN_M) + 1), dtype=np.float32)
    points, normals = np.ascontiguousarray(points[order]), np.ascontiguousarray(normals[order])
    blocks = block.ravel()[order].astype(np.int64)
    vote(points, normals, blocks, held.points, held.normals, held.radii, direction, _GATE_M, BIN_M, votes)
    return np.asarray(np.minimum(votes, _MOST_OF_BLOCK).sum(axis=0), dtype=np.float64)
