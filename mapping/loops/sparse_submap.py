"""A keyframe's submap as loop detection keeps it: a few thousand points with normals, and a range image."""

import math
import pickle
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray, levelling
from lidarslam.core.state import BlockFile
from lidarslam.core.thinning import evenly, one_per_cell
from lidarslam.mapping.surfels.symmetric import SYMMETRIC, write_eigenvalues, write_eigenvector

PLANE, LINE = 1, 2
# Nearer points are mostly the carrier itself.
_MIN_RANGE_M = 0.5
_MAX_POINTS = 2500
# The cell, the unit of most gates, is this part of the median range, within bounds.
_CELLS_PER_RANGE = 30.0
_CELL_BOUNDS_M = (0.08, 0.5)
_NEIGHBOURS = 10
# Ratios of eigenvalues: thinner than this share of its width is a plane, narrower than this of its length a line.
_THIN = 0.08
_NARROW = 0.06
_POLE = 0.7
# Pixels of the range image: 3 degrees of azimuth and elevation.
PIXELS = (120, 60)
# Cosine of the largest angle between "up" and the sensor's axis.
_LARGEST_TILT = np.cos(np.deg2rad(45.0))
# Submaps that stay in memory, those used last: about 15 MB.
_KEPT = 256


@dataclass(frozen=True, eq=False)
class SparseSubmap:
    """A thinned submap, about 55 kB, in its keyframe's LiDAR frame."""

    points: NDArray[np.float32]  # (N, 3) float32, thinned
    axes: NDArray[np.float16]  # (N, 3) float16, of planes the normals, towards the sensor, of lines the directions
    tilt: NDArray[np.float16]  # (N,) float16, standard deviation of the axes, radians
    kinds: NDArray[np.uint8]  # (N,) uint8, `PLANE`, `LINE` or 0 for neither
    # (azimuth, elevation) float16, the nearest range seen in each direction; 0 where nothing was
    range_image: NDArray[np.float16]
    range_m: float  # the median range
    cell_m: float  # the size of detail that suits it
    # (3, 3) that stands the sensor upright: "up", or if it hangs upside down "down", becomes z
    R_level_lidar: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def of(cls, points: FloatArray, max_range_m: float) -> "SparseSubmap":
        """Thin a submap (N, 3), and classify its points by principal components."""
        ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
        kept = (ranges >= _MIN_RANGE_M) & (ranges <= max_range_m)
        points, ranges = points[kept], ranges[kept]
        range_m = float(np.median(ranges)) if len(ranges) else 1.0
        cell_m = float(np.clip(range_m / _CELLS_PER_RANGE, *_CELL_BOUNDS_M))
        fine = points[one_per_cell(points, 0.5 * cell_m)]
        chosen = evenly(one_per_cell(fine, 2.0 * cell_m), _MAX_POINTS)
        kinds, axes, tilt = _shapes(fine, fine[chosen])
        image = np.full(PIXELS[0] * PIXELS[1], np.inf)
        np.minimum.at(image, _pixels(points, ranges), ranges)
        image[np.isinf(image)] = 0.0
        return cls(
            fine[chosen].astype(np.float32), axes.astype(np.float16), tilt.astype(np.float16), kinds,
            image.astype(np.float16).reshape(PIXELS), range_m, cell_m, _level_rotation(axes[kinds == PLANE]),
        )  # fmt: skip

    def nearest_ranges(self, points: FloatArray) -> FloatArray:
        """(N,) the nearest range that the keyframe saw in the directions of points (N, 3); 0 where nothing was."""
        flat = self.range_image.ravel()
        return flat[_pixels(points, np.linalg.norm(points, axis=1))].astype(np.float64)


@compiled
def _pixels(points: FloatArray, ranges: FloatArray) -> NDArray[np.intp]:
    """(N,) flat indices into a range image."""
    pixels = np.empty(len(points), dtype=np.intp)
    for n in range(len(points)):
        sine = min(max(points[n, 2] / max(ranges[n], 1e-9), -1.0), 1.0)
        azimuth = (math.atan2(points[n, 1], points[n, 0]) / (2.0 * math.pi) + 0.5) * PIXELS[0]
        elevation = (math.asin(sine) / math.pi + 0.5) * PIXELS[1]
        pixels[n] = min(int(azimuth), PIXELS[0] - 1) * PIXELS[1] + min(int(elevation), PIXELS[1] - 1)
    return pixels


def principal_components(
    cloud: FloatArray, tree: cKDTree, points: FloatArray, neighbours: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centroids (N, 3), eigenvalues (N, 3) ascending and eigenvectors (N, 3, 3) of the cloud around points (N, 3)."""
    _, nearest = tree.query(points, k=neighbours, workers=1)
    return _components(np.ascontiguousarray(cloud), nearest.reshape(len(points), -1))


@compiled
def _components(cloud: FloatArray, nearest: NDArray[np.intp]) -> tuple[FloatArray, FloatArray, FloatArray]:
    count = len(nearest)
    centroids, spread, directions = np.zeros((count, 3)), np.empty((count, 3)), np.empty((count, 3, 3))
    scatter, offset, least, largest = np.empty(6), np.empty(3), np.empty(3), np.empty(3)
    for n in range(count):
        for row in nearest[n]:
            for i in range(3):
                centroids[n, i] += cloud[row, i] / nearest.shape[1]
        scatter[:] = 0.0
        for row in nearest[n]:
            for i in range(3):
                offset[i] = cloud[row, i] - centroids[n, i]
            for entry in range(6):
                i, j = SYMMETRIC[entry]
                scatter[entry] += offset[i] * offset[j]
        write_eigenvalues(scatter, spread[n])
        write_eigenvector(scatter, spread[n, 0], least)
        write_eigenvector(scatter, spread[n, 2], largest)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            directions[n, i, 0], directions[n, i, 2] = least[i], largest[i]
            directions[n, i, 1] = largest[j] * least[k] - largest[k] * least[j]
    return centroids, spread, directions


def _shapes(cloud: FloatArray, points: FloatArray) -> tuple[NDArray[np.uint8], FloatArray, FloatArray]:
    """Kinds (N,), axes (N, 3) and their deviations (N,) of the cloud around each point."""
    if len(cloud) < _NEIGHBOURS:
        return np.zeros(len(points), dtype=np.uint8), np.zeros((len(points), 3)), np.ones(len(points))
    tree = cKDTree(cloud, balanced_tree=False, compact_nodes=False)
    _, spread, directions = principal_components(cloud, tree, points, _NEIGHBOURS)
    spread = np.maximum(spread, 1e-12)
    narrow = spread[:, 1] < _NARROW * spread[:, 2]
    # A single ring of the sensor on a wall is as narrow as a pole, but lies across the axis it turns about.
    line = narrow & (np.abs(directions[:, 2, 2]) > _POLE)
    plane = ~narrow & (spread[:, 0] < _THIN * spread[:, 1])
    kinds = np.where(plane, PLANE, np.where(line, LINE, 0)).astype(np.uint8)
    axes = np.where(line[:, None], directions[:, :, 2], directions[:, :, 0])
    axes[np.einsum("ij,ij->i", axes, points) > 0.0] *= -1.0
    tilt = np.sqrt(np.where(line, spread[:, 1] / spread[:, 2], spread[:, 0] / spread[:, 1]) / _NEIGHBOURS)
    return kinds, axes, tilt


def _level_rotation(normals: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes the mean of the normals (N, 3) near the sensor's z axis to z.

    Floor and ceiling count equally, so z may end up pointing down.
    """
    axis = np.array([0.0, 0.0, 1.0])
    for least in (_LARGEST_TILT, 0.9, 0.97, 0.99):
        along = normals @ axis
        near = np.abs(along) > least
        if near.sum() < 20:
            break
        mean = (normals[near] * np.sign(along[near])[:, None]).sum(axis=0)
        axis = mean / np.linalg.norm(mean)
    return levelling(axis)


class SubmapFile(BlockFile):
    """Sparse submaps in order, in a file without a name: those of hours would take hundreds of megabytes of memory."""

    def __init__(self, directory: Path | None = None) -> None:
        super().__init__(directory)
        self._recent = lru_cache(_KEPT)(self._unpickled)

    def __getitem__(self, index: int) -> SparseSubmap:
        return self._recent(range(len(self))[index])

    def append(self, submap: SparseSubmap) -> None:
        """Keep one more; OSError where the disk is full."""
        self.write(pickle.dumps(submap))

    def _unpickled(self, index: int) -> SparseSubmap:
        submap: SparseSubmap = pickle.loads(self.read(index))  # noqa: S301 (of a file that nobody else can open)
        return submap
