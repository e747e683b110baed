"""Where in the map a scan may lie, when nothing is known but which way is up: both from above, one laid on the other.

Only what stands upright is drawn: columns of space that are filled at several heights. Where the scan has seen through,
the map should be empty. All shifts are compared at once, by correlation, turn after turn, as in RING++ (Xu et al.,
IEEE T-RO 2023) and in Olson's correlative scan matching (ICRA 2009).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.thinning import one_per_cell

_TURNS = 72
# Peaks of the correlation that are kept of each turn, and how far apart peaks are, in cells and radians.
_PEAKS = 3
_APART = 3.0
_APART_RAD = np.deg2rad(12.0)
# A column counts by how many heights it is filled at, beyond those of a floor and a ceiling, up to the last.
_FLAT, _TALL = 2, 8
_HEIGHT_BINS = 2  # a cell's edge
# What was seen through counts this much of what was seen.
_SEEN_THROUGH = 0.25
_ALONG_RAYS = np.linspace(0.1, 0.85, 12)
_LEVEL_SINE = 0.2  # of rays that tell whether a column is empty
# The largest drawing, in cells to either side of the middle.
_MOST_CELLS = 512


@dataclass(frozen=True, eq=False)
class Floorplan:
    """A map from above, upright.

    Attributes:
        R_level_world: (3, 3) that takes up to z.
        points: (M, 3) of the map, level.
        corner: (2,) of the drawing, level.
        cell_m: edge of a cell.
        columns: (X, Y) how high things stand.
    """

    R_level_world: FloatArray
    points: FloatArray
    corner: FloatArray
    cell_m: float
    columns: FloatArray

    @classmethod
    def of(cls, points: FloatArray, up: FloatArray, cell_m: float) -> "Floorplan":
        """Draw points (N, 3) of the world, up being (3,) there."""
        R_level_world = _levelling(up)
        level = points @ R_level_world.T
        middle = np.median(level[:, :2], axis=0) if len(level) else np.zeros(2)
        near = (np.abs(level[:, :2] - middle) < _MOST_CELLS * cell_m).all(axis=1)
        level = level[near]
        corner = level[:, :2].min(axis=0) if len(level) else np.zeros(2)
        return cls(R_level_world, level, corner, cell_m, _columns(level, corner, cell_m))

    def find(self, points: FloatArray, T_world_lidar: FloatArray, reach_m: float, most: int) -> FloatArray:
        """Poses (K, 4, 4), the likeliest first, that lay points (N, 3) of a LiDAR frame on the map.

        They are those of a sensor that leans as `T_world_lidar` (4, 4) does, anywhere and turned anyhow.

        Args:
            points: compensated.
            T_world_lidar: only its rotation counts.
            reach_m: points farther from the sensor are left out.
            most: K is at most that.
        """
        level = points @ (self.R_level_world @ T_world_lidar[:3, :3]).T
        level = level[np.einsum("ij,ij->i", level[:, :2], level[:, :2]) < reach_m**2]
        level = level[one_per_cell(level, self.cell_m / _HEIGHT_BINS)]
        size = next_fast_len(max(self.columns.shape) + 2 * int(np.ceil(reach_m / self.cell_m)) + 2, real=True)
        spectrum = rfft2(self.columns, s=(size, size))
        peaks = []
        for yaw in np.arange(_TURNS) * (2.0 * np.pi / _TURNS):
            c, s = np.cos(yaw), np.sin(yaw)
            image = _image(level @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]), reach_m, self.cell_m)
            norm = float(np.linalg.norm(image))
            if norm == 0.0:
                return np.empty((0, 4, 4))
            overlay = irfft2(spectrum * np.conj(rfft2(image, s=(size, size))), s=(size, size)) / norm
            peaks += [(score, yaw, self._place(shift, size, reach_m)) for score, shift in _highest(overlay)]
        chosen = _apart(sorted(peaks, key=lambda peak: -peak[0]), _APART * self.cell_m, most)
        return np.array([self._pose(yaw, xy, level, T_world_lidar, reach_m) for yaw, xy in chosen]).reshape(-1, 4, 4)

    def _place(self, shift: NDArray[np.intp], size: int, reach_m: float) -> FloatArray:
        """Where (2,) the sensor is when a drawing around it is shifted by so many cells (2,), modulo the size."""
        shift = np.where(shift < max(self.columns.shape), shift, shift - size)
        return np.asarray(self.corner + self.cell_m * shift + reach_m, dtype=np.float64)

    def _pose(
        self, yaw: float, xy: FloatArray, level: FloatArray, T_world_lidar: FloatArray, reach_m: float
    ) -> FloatArray:
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        around = self.points[np.einsum("ij,ij->i", self.points[:, :2] - xy, self.points[:, :2] - xy) < reach_m**2]
        z = _rise(around[:, 2], level[:, 2], self.cell_m / _HEIGHT_BINS)
        R = self.R_level_world.T @ turn @ self.R_level_world @ T_world_lidar[:3, :3]
        return make_transform(R, self.R_level_world.T @ np.array([*xy, z]))


def _levelling(up: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes a unit vector (3,) near z to z."""
    v = np.array([up[1], -up[0], 0.0])
    K = np.array([[0.0, 0.0, v[1]], [0.0, 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + up[2]), dtype=np.float64)


def _columns(level: FloatArray, corner: FloatArray, cell_m: float) -> FloatArray:
    """(X, Y) at how many heights each column is filled, on a scale that ends."""
    if not len(level):
        return np.zeros((1, 1))
    cells = np.floor((level - [*corner, level[:, 2].min()]) / (cell_m / np.array([1.0, 1.0, _HEIGHT_BINS])))
    i, j, k = cells.astype(np.intp).T
    wide, deep, high = int(i.max()) + 1, int(j.max()) + 1, int(k.max()) + 1
    filled = np.unique((i * deep + j) * high + k)
    counts = np.bincount(filled // high, minlength=wide * deep).reshape(wide, deep)
    return np.asarray(np.sqrt(np.clip(counts - _FLAT, 0.0, _TALL)), dtype=np.float64)


def _image(level: FloatArray, reach_m: float, cell_m: float) -> FloatArray:
    """What a scan (N, 3) shows about the sensor: columns, and below zero what was seen through."""
    corner = np.array([-reach_m, -reach_m])
    side = 2 * int(np.ceil(reach_m / cell_m)) + 1
    drawn = _columns(level, corner, cell_m)
    image = np.zeros((side, side))
    image[: drawn.shape[0], : drawn.shape[1]] = drawn
    ranges = np.linalg.norm(level, axis=1)
    flat = level[np.abs(level[:, 2]) < _LEVEL_SINE * ranges, :2]
    through = (flat[:, None] * _ALONG_RAYS[:, None]).reshape(-1, 2)
    cells = np.floor((through - corner) / cell_m).astype(np.intp)
    seen = np.zeros_like(image, dtype=np.bool_)
    seen[cells[:, 0], cells[:, 1]] = True
    image[seen & (image == 0.0)] = -_SEEN_THROUGH * float(image.max(initial=0.0))
    return image


def _highest(overlay: FloatArray) -> list[tuple[float, NDArray[np.intp]]]:
    """The highest few values that are apart, and where (2,) each is."""
    found = []
    size, reach = len(overlay), int(_APART)
    around = np.arange(-reach, reach + 1)
    for _ in range(_PEAKS):
        i, j = np.unravel_index(int(overlay.argmax()), overlay.shape)
        found.append((float(overlay[i, j]), np.array([i, j], dtype=np.intp)))
        overlay[np.ix_((i + around) % size, (j + around) % size)] = -np.inf
    return found


def _apart(
    peaks: list[tuple[float, float, FloatArray]], distance_m: float, most: int
) -> list[tuple[float, FloatArray]]:
    """Turns and places (2,) of the first of the peaks of which no two are one place."""
    chosen: list[tuple[float, FloatArray]] = []
    for _, yaw, xy in peaks:
        if all(
            np.linalg.norm(xy - other) > distance_m or abs((yaw - turn + np.pi) % (2.0 * np.pi) - np.pi) > _APART_RAD
            for turn, other in chosen
        ):
            chosen.append((yaw, xy))
            if len(chosen) == most:
                break
    return chosen


def _rise(there: FloatArray, here: FloatArray, bin_m: float) -> float:
    """By how much the scan's heights (N,) lie lower than the map's (M,), where the two agree best."""
    if not len(there) or not len(here):
        return 0.0
    low, high = min(there.min(), here.min()), max(there.max(), here.max())
    bins = int((high - low) / bin_m) + 1
    a, b = (np.sqrt(np.histogram(h, bins, (low, low + bins * bin_m))[0]) for h in (there, here))
    return (int(np.correlate(a, b, mode="full").argmax()) - (bins - 1)) * bin_m
