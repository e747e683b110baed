"""What is kept of a keyframe's submap, so that places can be recognised and laid on one another.

A few thousand points, each with what it lies on, and how far the sensor could see in every direction.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lidarslam.core.geometry import FloatArray
from lidarslam.core.thinning import one_per_cell

PLANE, LINE = 1, 2
_NEIGHBOURS = 10
# Thinner than this share of its width is a plane, narrower than this share of its length a line.
_THIN = 0.08
_NARROW = 0.06
_POLE = 0.7
_CELL_BOUNDS_M = (0.08, 0.5)
# The sight of a keyframe: cells of 3 degrees of azimuth and elevation.
SIGHT = (120, 60)
# From the sensor's axis, "up" may be so far.
_LARGEST_TILT = np.cos(np.deg2rad(45.0))


@dataclass(frozen=True, eq=False)
class Patch:
    """What is kept of a keyframe's submap, all in its LiDAR frame.

    Attributes:
        points: (N, 3) float32, thinned.
        axes: (N, 3) float16, of planes the normals, towards the sensor, of lines the directions.
        tilt: (N,) float16, standard deviation of the axes, radians.
        kinds: (N,) uint8, `PLANE`, `LINE` or 0 for neither.
        sight: SIGHT, float16, the nearest range seen in each direction; 0 where nothing was.
        range_m: the median range.
        cell_m: the size of detail that suits it.
        R_level_lidar: (3, 3) that stands the sensor upright: "up", or if it hangs upside down "down", becomes z.
    """

    points: NDArray[np.float32]
    axes: NDArray[np.float16]
    tilt: NDArray[np.float16]
    kinds: NDArray[np.uint8]
    sight: NDArray[np.float16]
    range_m: float
    cell_m: float
    R_level_lidar: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return sum(a.nbytes for a in (self.points, self.axes, self.tilt, self.kinds, self.sight, self.R_level_lidar))


def make_patch(
    points: FloatArray, min_range_m: float, max_range_m: float, cells_per_range: float, max_points: int
) -> Patch:
    """Thin a submap (N, 3), and say what its points lie on."""
    ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
    kept = (ranges >= min_range_m) & (ranges <= max_range_m)  # neither holds of what is not finite
    points, ranges = points[kept], ranges[kept]
    range_m = float(np.median(ranges)) if len(ranges) else 1.0
    cell_m = float(np.clip(range_m / cells_per_range, *_CELL_BOUNDS_M))
    fine = points[one_per_cell(points, 0.5 * cell_m)]
    chosen = one_per_cell(fine, 2.0 * cell_m)
    if len(chosen) > max_points:
        chosen = chosen[np.linspace(0, len(chosen) - 1, max_points).astype(np.intp)]
    kinds, axes, tilt = _shapes(fine, fine[chosen])
    return Patch(
        fine[chosen].astype(np.float32), axes.astype(np.float16), tilt.astype(np.float16), kinds,
        _sight(points, ranges), range_m, cell_m, level_rotation(axes[kinds == PLANE]),
    )  # fmt: skip


def sight_cells(points: FloatArray, ranges: FloatArray) -> NDArray[np.intp]:
    """The flat index (N,) into a sight in which directions lie."""
    azimuth = (np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5) * SIGHT[0]
    sine = np.clip(points[:, 2] / np.maximum(ranges, 1e-9), -1.0, 1.0)
    elevation = (np.arcsin(sine) / np.pi + 0.5) * SIGHT[1]
    rows = np.minimum(azimuth.astype(np.intp), SIGHT[0] - 1)
    return rows * SIGHT[1] + np.minimum(elevation.astype(np.intp), SIGHT[1] - 1)


def _sight(points: FloatArray, ranges: FloatArray) -> NDArray[np.float16]:
    nearest = np.full(SIGHT[0] * SIGHT[1], np.inf)
    np.minimum.at(nearest, sight_cells(points, ranges), ranges)
    nearest[np.isinf(nearest)] = 0.0
    return nearest.astype(np.float16).reshape(SIGHT)


def _shapes(cloud: FloatArray, points: FloatArray) -> tuple[NDArray[np.uint8], FloatArray, FloatArray]:
    """Kinds (N,), axes (N, 3) and their deviations (N,) of the cloud around each point, by principal components."""
    if len(cloud) < _NEIGHBOURS:
        return np.zeros(len(points), dtype=np.uint8), np.zeros((len(points), 3)), np.ones(len(points))
    _, neighbours = cKDTree(cloud, balanced_tree=False, compact_nodes=False).query(points, k=_NEIGHBOURS)
    around = cloud[neighbours]
    around -= around.mean(axis=1, keepdims=True)
    spread, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
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


def level_rotation(normals: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes the sensor's z axis to where most normals (N, 3) near it point.

    Floor and ceiling count alike, and nothing is said about which of the two z looks at.
    """
    axis = np.array([0.0, 0.0, 1.0])
    for least in (_LARGEST_TILT, 0.9, 0.97, 0.99):
        along = normals @ axis
        near = np.abs(along) > least
        if near.sum() < 20:
            break
        mean = (normals[near] * np.sign(along[near])[:, None]).sum(axis=0)
        axis = mean / np.linalg.norm(mean)
    v = np.array([axis[1], -axis[0], 0.0])  # the cross product of the axis and z
    K = np.array([[0.0, 0.0, v[1]], [0.0, 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + axis[2]), dtype=np.float64)
