"""Bird's-eye descriptors of submaps, for loop detection whatever the heading.

A submap is seen from above, only its upright structure. Projections onto lines in all directions (the Radon transform)
keep, as magnitudes of their Fourier transforms, nothing of the sensor's position; turning it shifts them from direction
to direction, and one circular correlation compares all turns. After RING++ (Xu et al., IEEE T-RO 2023). The position
follows from correlating the two views.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft2

from lidarslam.core.geometry import FloatArray, inverse, make_transform, rotation_z
from lidarslam.mapping.loops.sparse_submap import PLANE, SparseSubmap
from lidarslam.mapping.tracking.birds_eye_map import correlate, height_shift

_DIRECTIONS = 60  # over half a turn
_BINS = 64
_FREQUENCIES = 24
# Planes whose normal is farther from level are no upright structure.
_UPRIGHT = 0.6
_HEIGHT_BIN_M = 0.1


@dataclass(frozen=True, eq=False)
class BirdsEyeView:
    """A submap from above: `structure` (M, 2) of its upright points, `heights` (N,) of all."""

    structure: FloatArray
    heights: FloatArray
    R_level_lidar: FloatArray

    @classmethod
    def of(cls, submap: SparseSubmap, upside_down: bool = False) -> "BirdsEyeView":
        """View a submap; upside down where its sensor is mounted the other way up than that of the others."""
        R = np.diag([1.0, -1.0, -1.0]) @ submap.R_level_lidar if upside_down else submap.R_level_lidar
        level = submap.points.astype(np.float64) @ R.T
        upright = np.abs(submap.axes.astype(np.float64) @ R[2])
        structure = np.where(submap.kinds == PLANE, upright < _UPRIGHT, True)
        return cls(level[structure, :2], level[:, 2], R)

    def descriptor(self, radius_m: float) -> NDArray[np.complex64]:
        """(DIRECTIONS / 2 + 1, FREQUENCIES), of unit length, by directions."""
        xy = self.structure
        weights = np.clip(1.0 - np.einsum("ij,ij->i", xy, xy) / radius_m**2, 0.0, None)
        xy, weights = xy[weights > 0.0], weights[weights > 0.0]
        angles = np.arange(_DIRECTIONS) * (np.pi / _DIRECTIONS)
        along = xy @ np.stack([np.cos(angles), np.sin(angles)])  # (N, DIRECTIONS)
        bins = np.clip(((along / radius_m + 1.0) * (0.5 * _BINS)).astype(np.intp), 0, _BINS - 1)
        flat = bins + _BINS * np.arange(_DIRECTIONS)
        lines = np.bincount(flat.ravel(), np.repeat(weights, _DIRECTIONS), minlength=_DIRECTIONS * _BINS)
        magnitudes = np.sqrt(np.abs(np.fft.rfft(lines.reshape(_DIRECTIONS, _BINS), axis=1)[:, 1 : _FREQUENCIES + 1]))
        magnitudes -= magnitudes.mean(axis=0)
        magnitudes /= max(float(np.linalg.norm(magnitudes)), 1e-12)
        return np.fft.rfft(magnitudes, axis=0).astype(np.complex64)


def compare(descriptor: NDArray[np.complex64], others: NDArray[np.complex64]) -> tuple[FloatArray, FloatArray]:
    """Similarities (M,), at most 1, with other descriptors (M, ...), and turns (M,), to half a turn, from 0 to pi."""
    correlation = np.fft.irfft(np.einsum("mdf,df->md", others, descriptor.conj()), _DIRECTIONS, axis=1)
    best = correlation.argmax(axis=1)
    return correlation[np.arange(len(others)), best].astype(np.float64), best * (np.pi / _DIRECTIONS)


def align(
    target: BirdsEyeView, source: BirdsEyeView, yaws: FloatArray, radius_m: float,
    expected_xy: FloatArray | None = None, within_m: float = 0.0,
) -> tuple[FloatArray, float]:  # fmt: skip
    """`T_target_source` (4, 4), in the LiDAR frames, by correlation of two views; and the score, 0 to 1.

    Turns (Y,) of the source, upright, are tried. Its position, upright, in the target's view is expected at some (2,)
    within a distance, or anywhere.
    """
    cell_m = 2.0 * radius_m / _BINS
    size = next_fast_len(2 * _BINS, real=True)
    there = _image(target.structure, radius_m, size)
    spectrum, length = rfft2(there), np.sqrt(np.sum(there * there))
    shifts = cell_m * ((np.arange(size) + size // 2) % size - size // 2)
    prior = 1.0
    if expected_xy is not None:
        squared = np.add.outer((shifts - expected_xy[0]) ** 2, (shifts - expected_xy[1]) ** 2)
        prior = np.clip(1.0 - squared / (within_m + cell_m) ** 2, 0.0, None)
    score, turn, shift = -1.0, np.eye(3), [0.0, 0.0]
    for yaw in yaws:
        R = rotation_z(yaw)
        here = _image(source.structure @ R[:2, :2].T, radius_m, size)
        overlay = prior * correlate(spectrum, here, (size, size))
        peak = np.unravel_index(int(overlay.argmax()), overlay.shape)
        here_score = float(overlay[peak] / max(length * np.sqrt(np.sum(here * here)), 1e-12))
        if here_score > score:
            score, shift, turn = here_score, shifts[list(peak)].tolist(), R
    moved = make_transform(turn, [*shift, height_shift(target.heights, source.heights, _HEIGHT_BIN_M)])
    target_level = make_transform(target.R_level_lidar, np.zeros(3))
    return inverse(target_level) @ moved @ make_transform(source.R_level_lidar, np.zeros(3)), score


def _image(xy: FloatArray, radius_m: float, size: int) -> FloatArray:
    """(size, size) counts of points, on a scale that ends at a few."""
    cells = ((xy / radius_m + 1.0) * (0.5 * _BINS)).astype(np.intp)
    cells = cells[((xy > -radius_m) & (xy < radius_m)).all(axis=1)]
    counts = np.bincount(cells[:, 0] * size + cells[:, 1], minlength=size * size).reshape(size, size)
    return np.asarray(np.sqrt(np.minimum(counts, 8)), dtype=np.float64)
