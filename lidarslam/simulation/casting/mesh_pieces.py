"""Pieces of a mesh near given places: large triangles are cut down, and those far from the places are dropped."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.casting.mesh import Mesh

IntArray = NDArray[np.int64]

# Pieces are no larger than cells of this many voxels.
PIECE_VOXELS = 8
_STRIDES = np.array([1, 1 << 20, 1 << 40])
_NEIGHBOURS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3) @ _STRIDES
_BLOCK = 1 << 17


@dataclass(frozen=True, eq=False)
class Pieces:
    """Triangles cut out of a mesh.

    `starts` and `ends` are the area of the mesh before the piece, and with it, in the order of the mesh's triangles
    and of cutting: they number a piece's samples alike, whichever pieces were dropped.
    """

    corners: FloatArray  # (P, 3, 3)
    starts: FloatArray  # (P,)
    ends: FloatArray  # (P,)

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

    def __getitem__(self, chosen: NDArray[Any]) -> "Pieces":
        return Pieces(self.corners[chosen], self.starts[chosen], self.ends[chosen])


def pieces_near(mesh: Mesh, voxels: IntArray, voxel_m: float) -> Pieces:
    """Triangles that together cover all of the mesh that lies in the voxels (N, 3), and little more.

    Cutting keeps the triangles' planes and orientation. The pieces are in the order of their places, z first;
    triangles without area are left out.
    """
    size = voxel_m * PIECE_VOXELS
    cells = np.unique((voxels // PIECE_VOXELS) @ _STRIDES)
    near = np.unique((cells[:, None] + _NEIGHBOURS).ravel())
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    ends = np.cumsum(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    starts = np.concatenate([[0.0], ends[:-1]])
    found = []
    for block in np.array_split(np.flatnonzero(ends > starts), len(ends) // _BLOCK + 1):
        pieces = _cut(Pieces(mesh.vertices[mesh.triangles[block]], starts[block], ends[block]), size)
        # A piece no larger than a cell lies in its middle's cell and those that touch it.
        found.append(pieces[np.isin(_place(pieces, size), near)])
    pieces = _together(found)
    return pieces[np.argsort(_place(pieces, size), kind="stable")]


def _cut(pieces: Pieces, size: float) -> Pieces:
    """Halve triangles across their longest edges until none extends farther than `size` along an axis."""
    done = []
    while True:
        low, high = pieces.bounds
        is_large = np.asarray(((high - low) > size).any(axis=1))
        done.append(pieces[~is_large])
        if not is_large.any():
            return _together(done)
        pieces = pieces[is_large]
        lengths = np.linalg.norm(np.roll(pieces.corners, -1, axis=1) - pieces.corners, axis=2)
        order = (lengths.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(pieces.corners, order[:, :, None], axis=1), 1, 0)
        middle, half = 0.5 * (a + b), 0.5 * (pieces.starts + pieces.ends)
        one = Pieces(np.stack([a, middle, c], axis=1), pieces.starts, half)
        pieces = _together([one, Pieces(np.stack([middle, b, c], axis=1), half, pieces.ends)])


def _together(parts: list[Pieces]) -> Pieces:
    return Pieces(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "starts", "ends")))


def _place(pieces: Pieces, size: float) -> IntArray:
    """One number (P,) for the cell that the middle of each piece's bounding box lies in."""
    low, high = pieces.bounds
    return np.asarray(np.floor(0.5 / size * (low + high)).astype(np.int64) @ _STRIDES)
