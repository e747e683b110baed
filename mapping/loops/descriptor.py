"""Places that look alike, whichever way they are faced, and the search among all that are kept.

A place is drawn from above, only what stands upright. Its projections onto lines in all directions (the Radon
transform) keep, as magnitudes of their Fourier transforms, nothing of where the sensor stood; turning it shifts them
from direction to direction, and one circular correlation compares all turns. The idea is that of RING++ (Xu et al.,
IEEE T-RO 2023). Where the sensor stood comes from correlating the two drawings.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from lidarslam.core.geometry import FloatArray, inverse, make_transform
from mapping.loops.place import PLANE, Patch

_DIRECTIONS = 60  # over half a turn
_BINS = 64
_FREQUENCIES = 24
_UPRIGHT = 0.6
_HEIGHT_BIN_M = 0.1


@dataclass(frozen=True, eq=False)
class Drawing:
    """A place from above, standing upright: `structure` (M, 2) of what is upright, `heights` (N,) of everything."""

    structure: FloatArray
    heights: FloatArray
    R_level_lidar: FloatArray

    @classmethod
    def of(cls, patch: Patch, upside_down: bool = False) -> "Drawing":
        """Draw a patch; upside down when its sensor hangs the other way than that of those it is compared with."""
        R = patch.R_level_lidar
        if upside_down:
            R = np.diag([1.0, -1.0, -1.0]) @ R
        level = patch.points.astype(np.float64) @ R.T
        upright = np.abs(patch.axes.astype(np.float64) @ R[2])
        structure = np.where(patch.kinds == PLANE, upright < _UPRIGHT, True)
        return cls(level[structure, :2], level[:, 2], R)

    def signature(self, radius_m: float) -> NDArray[np.complex64]:
        """(DIRECTIONS / 2 + 1, FREQUENCIES), of unit length: what correlates by directions."""
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


class Places:
    """The signatures of all keyframes, in order; they take 6 kB each."""

    def __init__(self) -> None:
        self._signatures = np.empty((64, _DIRECTIONS // 2 + 1, _FREQUENCIES), dtype=np.complex64)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def nbytes(self) -> int:
        """Memory of the signatures."""
        return int(self._count * self._signatures[0].nbytes)

    def add(self, signature: NDArray[np.complex64]) -> None:
        """Keep the signature of the next keyframe."""
        if self._count == len(self._signatures):
            self._signatures = np.concatenate([self._signatures, np.empty_like(self._signatures)])
        self._signatures[self._count] = signature
        self._count += 1

    def compare(self, signature: NDArray[np.complex64], chosen: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Similarities (M,), at most 1, with the chosen keyframes, and by how much (M,) the sensor has turned.

        The turn, in radians from 0 to pi, may be half a turn more.
        """
        products = np.einsum("mdf,df->md", self._signatures[chosen], signature.conj())
        correlation = np.fft.irfft(products, _DIRECTIONS, axis=1)
        best = correlation.argmax(axis=1)
        return correlation[np.arange(len(chosen)), best].astype(np.float64), best * (np.pi / _DIRECTIONS)


@dataclass(frozen=True, eq=False)
class Expected:
    """Where a source's sensor is thought to stand, upright, in the target's drawing: (2,), and how far off at most."""

    xy: FloatArray
    within_m: float


def lay_over(
    target: Drawing, source: Drawing, yaws: FloatArray, radius_m: float, expected: Expected | None = None
) -> tuple[FloatArray, float]:
    """`T_target_source` (4, 4), in the LiDAR frames, that lays one drawing best on another; and how well, 0 to 1.

    Args:
        target, source: the drawings.
        yaws: (Y,) turns of the source, upright, that are tried.
        radius_m: points farther from the sensor are left out.
        expected: of places that fit alike, the nearest to it counts; None: anywhere.
    """
    cell_m = 2.0 * radius_m / _BINS
    size = next_fast_len(2 * _BINS, real=True)
    there = _image(target.structure, radius_m, size)
    spectrum, length = rfft2(there), np.sqrt(np.sum(there * there))
    shifts = cell_m * ((np.arange(size) + size // 2) % size - size // 2)
    likely = 1.0
    if expected is not None:
        squared = np.add.outer((shifts - expected.xy[0]) ** 2, (shifts - expected.xy[1]) ** 2)
        likely = np.clip(1.0 - squared / (expected.within_m + cell_m) ** 2, 0.0, None)
    best: tuple[float, float, FloatArray] = (-1.0, 0.0, np.zeros(2))
    for yaw in yaws:
        c, s = np.cos(yaw), np.sin(yaw)
        here = _image(source.structure @ np.array([[c, s], [-s, c]]), radius_m, size)
        overlay = likely * irfft2(spectrum * np.conj(rfft2(here)), s=(size, size))
        peak = np.unravel_index(int(overlay.argmax()), overlay.shape)
        score = float(overlay[peak] / max(length * np.sqrt(np.sum(here * here)), 1e-12))
        if score > best[0]:
            best = (score, float(yaw), np.asarray(shifts[list(peak)], dtype=np.float64))
    score, yaw, shift = best
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = make_transform(turn, [*shift, _rise(target.heights, source.heights)])
    target_level = make_transform(target.R_level_lidar, np.zeros(3))
    return inverse(target_level) @ moved @ make_transform(source.R_level_lidar, np.zeros(3)), score


def _image(xy: FloatArray, radius_m: float, size: int) -> FloatArray:
    """(size, size) how high things stand in each cell, on a scale that ends at a few cells."""
    cells = ((xy / radius_m + 1.0) * (0.5 * _BINS)).astype(np.intp)
    cells = cells[((xy > -radius_m) & (xy < radius_m)).all(axis=1)]
    counts = np.bincount(cells[:, 0] * size + cells[:, 1], minlength=size * size).reshape(size, size)
    return np.asarray(np.sqrt(np.minimum(counts, 8)), dtype=np.float64)


def _rise(target: FloatArray, source: FloatArray) -> float:
    """By how much the source's heights lie lower than the target's, where the two agree best."""
    if not len(target) or not len(source):
        return 0.0
    low, high = min(target.min(), source.min()), max(target.max(), source.max())
    bins = int((high - low) / _HEIGHT_BIN_M) + 1
    there, here = (np.sqrt(np.histogram(h, bins, (low, low + bins * _HEIGHT_BIN_M))[0]) for h in (target, source))
    return (int(np.correlate(there, here, mode="full").argmax()) - (bins - 1)) * _HEIGHT_BIN_M
