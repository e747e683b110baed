"""Global relocalisation from above: correlation of bird's-eye views of a scan and of the map, for every yaw.

Only upright structure is drawn: columns of space that are occupied at several heights. Columns that rays of the scan
passed through should be empty in the map. All shifts are compared at once by FFT, as in RING++ (Xu et al., IEEE T-RO
2023) and in Olson's correlative scan matching (ICRA 2009).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from lidarslam.core.geometry import FloatArray, levelling, make_transform, rotation_z
from lidarslam.core.thinning import one_per_cell
from lidarslam.mapping.tracking.budget import Steps

_YAWS = 72
# Correlation peaks that are kept for each yaw as a rule, and their least distance, in cells and radians.
_PEAKS = 3
_APART = 3.0
_APART_RAD = np.deg2rad(12.0)
# Occupied heights of a column beyond those of a floor and a ceiling, up to a limit, make its value.
_FLAT, _TALL = 2, 8
_HEIGHT_BINS = 2  # of a cell's edge
# Weight of free space, and where along a nearly level ray it is drawn.
_FREE_WEIGHT = 0.25
_ALONG_RAYS = np.linspace(0.1, 0.85, 12)
_LEVEL_SINE = 0.2
# Spacing of the positions in free space that are drawn, in cells.
_FREE_SPACING = 0.4
# Largest extent of the map's image, in cells to either side of the middle.
_MOST_CELLS = 512


@dataclass(frozen=True, eq=False)
class BirdsEyeMap:
    """Image of the map from above, levelled."""

    R_level_world: FloatArray  # (3, 3) rotation that takes the vertical to z
    points: FloatArray  # (M, 3) of the map, levelled
    corner: FloatArray  # (2,) of the image, levelled
    cell_m: float  # edge of a cell
    columns: FloatArray  # (X, Y) image of the upright structure

    @classmethod
    def of(cls, points: FloatArray, up: FloatArray, cell_m: float) -> "BirdsEyeMap":
        """Draw points (N, 3) of the world, with the vertical `up` (3,)."""
        R_level_world = levelling(up)
        level = points @ R_level_world.T
        middle = np.median(level[:, :2], axis=0) if len(level) else np.zeros(2)
        near = (np.abs(level[:, :2] - middle) < _MOST_CELLS * cell_m).all(axis=1)
        level = level[near]
        corner = level[:, :2].min(axis=0) if len(level) else np.zeros(2)
        return cls(R_level_world, level, corner, cell_m, _columns(level, corner, cell_m))

    def find(
        self, points: FloatArray, T_world_lidar: FloatArray, reach_m: float, most: int, peaks_per_yaw: int = _PEAKS
    ) -> Steps[FloatArray]:
        """At most so many poses (K, 4, 4) of a scan by descending correlation, with the roll and pitch of a given pose.

        Of the scan's compensated points (N, 3), those within reach are drawn. More peaks per yaw are for similar
        places.
        """
        level = points @ (self.R_level_world @ T_world_lidar[:3, :3]).T
        level = level[np.einsum("ij,ij->i", level[:, :2], level[:, :2]) < reach_m**2]
        level = level[one_per_cell(level, self.cell_m / _HEIGHT_BINS)]
        free = _free_space(level, self.cell_m)
        beyond = 2 * int(np.ceil(reach_m / self.cell_m)) + 2
        size = tuple(next_fast_len(cells + beyond, real=True) for cells in self.columns.shape)
        spectrum = rfft2(self.columns.astype(np.float32), s=size)
        peaks = []
        for yaw in np.arange(_YAWS) * (2.0 * np.pi / _YAWS):
            yield
            turn = rotation_z(yaw).T
            image = _image(level @ turn, free @ turn[:2, :2], reach_m, self.cell_m)
            norm = float(np.linalg.norm(image))
            if norm == 0.0:
                return np.empty((0, 4, 4))
            correlation = np.asarray(correlate(spectrum, image, size) / norm, dtype=np.float32)
            peaks += [
                (score, yaw, self._position(shift, size, reach_m))
                for score, shift in _peaks(correlation, peaks_per_yaw)
            ]
        chosen = _apart(sorted(peaks, key=lambda peak: -peak[0]), _APART * self.cell_m, most)
        poses = []
        for yaw, xy in chosen:
            yield
            poses.append(self.pose_at(yaw, xy, level, T_world_lidar, reach_m))
        return np.array(poses).reshape(-1, 4, 4)

    def distance_m(self, x: float, y: float) -> float:
        """Distance of a position, levelled, from the nearest point."""
        if not len(self.points):
            return np.inf
        return float(np.linalg.norm(self.points[:, :2] - [x, y], axis=1).min())

    def _position(self, shift: NDArray[np.intp], size: tuple[int, ...], reach_m: float) -> FloatArray:
        """Position (2,) of the sensor for a shift (2,) of its image, in cells modulo the size."""
        shift = np.where(shift < self.columns.shape, shift, shift - size)
        return np.asarray(self.corner + self.cell_m * shift + reach_m, dtype=np.float64)

    def pose_at(
        self, yaw: float, xy: FloatArray, level: FloatArray, T_world_lidar: FloatArray, reach_m: float
    ) -> FloatArray:
        """Pose (4, 4) of a scan at a position (2,), levelled, turned by a yaw from a pose, at the height that fits.

        Its points (N, 3) are levelled at that pose.
        """
        away = self.points[:, :2] - xy
        around = self.points[np.einsum("ij,ij->i", away, away) < reach_m**2, 2]
        z = height_shift(around, level[:, 2], self.cell_m / _HEIGHT_BINS)
        R = self.R_level_world.T @ rotation_z(yaw) @ self.R_level_world @ T_world_lidar[:3, :3]
        return make_transform(R, self.R_level_world.T @ np.array([*xy, z]))


def _columns(level: FloatArray, corner: FloatArray, cell_m: float) -> FloatArray:
    """(X, Y) image of points (N, 3): square root of the number of occupied heights, clipped."""
    if not len(level):
        return np.zeros((1, 1))
    cells = np.floor((level - [*corner, level[:, 2].min()]) / (cell_m / np.array([1.0, 1.0, _HEIGHT_BINS])))
    i, j, k = cells.astype(np.intp).T
    wide, deep, high = int(i.max()) + 1, int(j.max()) + 1, int(k.max()) + 1
    occupied = np.unique((i * deep + j) * high + k)
    counts = np.bincount(occupied // high, minlength=wide * deep).reshape(wide, deep)
    return np.asarray(np.sqrt(np.clip(counts - _FLAT, 0.0, _TALL)), dtype=np.float64)


def _free_space(level: FloatArray, cell_m: float) -> FloatArray:
    """Positions (K, 2) that the nearly level rays of a scan (N, 3) passed through, some in each cell."""
    ranges = np.linalg.norm(level, axis=1)
    flat = level[np.abs(level[:, 2]) < _LEVEL_SINE * ranges]
    through = (flat[:, None] * _ALONG_RAYS[:, None]).reshape(-1, 3)
    through[:, 2] = 0.0
    kept: FloatArray = through[one_per_cell(through, _FREE_SPACING * cell_m), :2]
    return kept


def _image(level: FloatArray, free: FloatArray, reach_m: float, cell_m: float) -> NDArray[np.float32]:
    """Image of a scan (N, 3) around the sensor: columns, negative in free space (K, 2)."""
    corner = np.array([-reach_m, -reach_m])
    side = 2 * int(np.ceil(reach_m / cell_m)) + 1
    occupied = _columns(level, corner, cell_m)
    image = np.zeros((side, side), dtype=np.float32)
    image[: occupied.shape[0], : occupied.shape[1]] = occupied
    cells = np.floor((free - corner) / cell_m).astype(np.intp)
    seen = np.zeros_like(image, dtype=np.bool_)
    seen[cells[:, 0], cells[:, 1]] = True
    image[seen & (image == 0.0)] = -_FREE_WEIGHT * float(image.max(initial=0.0))
    return image


def _peaks(correlation: NDArray[np.float32], count: int) -> list[tuple[float, NDArray[np.intp]]]:
    """The highest few values that are apart, each with its cell (2,)."""
    found = []
    (wide, deep), reach = correlation.shape, int(_APART)
    around = np.arange(-reach, reach + 1)
    for _ in range(count):
        i, j = np.unravel_index(int(correlation.argmax()), correlation.shape)
        found.append((float(correlation[i, j]), np.array([i, j], dtype=np.intp)))
        correlation[np.ix_((i + around) % wide, (j + around) % deep)] = -np.inf
    return found


def _apart(
    peaks: list[tuple[float, float, FloatArray]], distance_m: float, most: int
) -> list[tuple[float, FloatArray]]:
    """Yaws and positions (2,) of the first peaks, no two of one pose."""
    chosen: list[tuple[float, FloatArray]] = []
    for _, yaw, xy in peaks:
        if all(
            np.linalg.norm(xy - other) > distance_m
            or abs((yaw - chosen_yaw + np.pi) % (2.0 * np.pi) - np.pi) > _APART_RAD
            for chosen_yaw, other in chosen
        ):
            chosen.append((yaw, xy))
            if len(chosen) == most:
                break
    return chosen


def correlate(spectrum: NDArray[Any], image: NDArray[Any], size: tuple[int, ...]) -> NDArray[Any]:
    """Sums of products of an image of some size, given by its `rfft2`, and another one at every shift of that."""
    correlation: NDArray[Any] = irfft2(spectrum * np.conj(rfft2(image, s=size)), s=size)
    return correlation


def height_shift(there: FloatArray, here: FloatArray, bin_m: float) -> float:
    """Shift between two sets of heights, (M,) and (N,), at which their histograms correlate best."""
    if not len(there) or not len(here):
        return 0.0
    low, high = min(there.min(), here.min()), max(there.max(), here.max())
    bins = int((high - low) / bin_m) + 1
    a, b = (np.sqrt(np.histogram(h, bins, (low, low + bins * bin_m))[0]) for h in (there, here))
    return (int(np.correlate(a, b, mode="full").argmax()) - (bins - 1)) * bin_m
