"""The pieces of a mesh near given places: large triangles are cut down, and what is far is dropped on the way."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.casting.mesh import Mesh

IntArray = NDArray[np.int64]

# Pieces become as small as cells of 2^level voxels, one level after the other: with each, what is far is dropped
# before the rest is cut further, so that the work is that of the surface nearby and not of the mesh.
_LEVELS = (8, 5, 3)
PIECE_VOXELS = 2 ** _LEVELS[-1]
_NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
_STRIDES = np.array([1, 1 << 20, 1 << 40])
_BLOCK = 1 << 17


@dataclass(frozen=True, eq=False)
class Pieces:
    """Triangles that were cut out of a mesh.

    Attributes:
        corners: (P, 3, 3).
        starts, ends: (P,) area of the mesh that comes before the piece, and with it, in the order of the mesh's
            triangles and of cutting: what numbers a piece's samples alike, whatever was dropped.
    """

    corners: FloatArray
    starts: FloatArray
    ends: FloatArray

    def __len__(self) -> int:
        return len(self.corners)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest coordinates (P, 3)."""
        a, b, c = np.moveaxis(self.corners, 1, 0)  # faster than to reduce an axis this short
        return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)

    @property
    def normals(self) -> FloatArray:
        """(P, 3) unit."""
        normals = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def __getitem__(self, chosen: NDArray[Any] | slice) -> "Pieces":
        return Pieces(self.corners[chosen], self.starts[chosen], self.ends[chosen])


def pieces_near(mesh: Mesh, voxels: IntArray, voxel_m: float) -> Pieces:
    """Triangles that together cover all of the mesh that lies in the voxels, and little more.

    Cutting keeps the triangles' planes and orientation. The pieces are in the order of their places, z first.

    Args:
        mesh: whose triangles are cut; those without area are left out.
        voxels: (N, 3) indices of the cells floor(x / voxel_m).
        voxel_m: edge of a voxel.
    """
    cells = [_around(voxels >> level) for level in _LEVELS]
    ends = np.cumsum(0.5 * np.linalg.norm(mesh.normals, axis=1))
    starts = np.concatenate([[0.0], ends[:-1]])
    found = []
    for first in range(0, len(mesh.triangles), _BLOCK):
        block = slice(first, first + _BLOCK)
        pieces = Pieces(mesh.vertices[mesh.triangles[block]], starts[block], ends[block])
        pieces = pieces[pieces.ends > pieces.starts]
        for level, near in zip(_LEVELS, cells, strict=True):
            size = voxel_m * 2.0**level
            pieces = cut(pieces, size)
            # A piece no larger than a cell lies in its middle's cell and those that touch it.
            pieces = pieces[contains(near, _place(pieces, size))]
        found.append(pieces)
    pieces = _together(found)
    return pieces[np.argsort(_place(pieces, voxel_m * 2.0 ** _LEVELS[-1]), kind="stable")]


def cut(pieces: Pieces, size: float) -> Pieces:
    """Halve triangles across their longest edges until none extends farther than `size` along an axis."""
    small = []
    while len(pieces):
        low, high = pieces.bounds
        is_large = np.asarray(((high - low) > size).any(axis=1))
        if not is_large.any():
            small.append(pieces)
            break
        small.append(pieces[~is_large])
        pieces = pieces[is_large]
        lengths = np.linalg.norm(np.roll(pieces.corners, -1, axis=1) - pieces.corners, axis=2)
        order = (lengths.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(pieces.corners, order[:, :, None], axis=1), 1, 0)
        middle, half = 0.5 * (a + b), 0.5 * (pieces.starts + pieces.ends)
        one = Pieces(np.stack([a, middle, c], axis=1), pieces.starts, half)
        pieces = _together([one, Pieces(np.stack([middle, b, c], axis=1), half, pieces.ends)])
    return _together(small)


def contains(sorted_numbers: IntArray, numbers: IntArray) -> NDArray[np.bool_]:
    """Whether each number (N,) is one of the sorted ones."""
    if not len(sorted_numbers):
        return np.zeros(len(numbers), dtype=bool)
    place = np.minimum(np.searchsorted(sorted_numbers, numbers), len(sorted_numbers) - 1)
    return np.asarray(sorted_numbers[place] == numbers)


def _together(parts: list[Pieces]) -> Pieces:
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return Pieces(np.empty((0, 3, 3)), np.empty(0), np.empty(0))
    return Pieces(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "starts", "ends")))


def _place(pieces: Pieces, size: float) -> IntArray:
    """One number (P,) for the cell that the middle of each piece's bounding box lies in."""
    low, high = pieces.bounds
    i, j, k = np.floor(0.5 / size * (low + high)).astype(np.int64).T
    return np.asarray(i * _STRIDES[0] + j * _STRIDES[1] + k * _STRIDES[2])


def _around(cells: IntArray) -> IntArray:
    """Sorted numbers of the cells (N, 3), of which many may be the same, and of all that touch them."""
    numbers = np.unique(cells @ _STRIDES)
    return np.unique((numbers[:, None] + _NEIGHBOURS @ _STRIDES).ravel())
