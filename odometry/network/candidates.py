"""Candidates of the motion between two scans: the highest peaks of the correlation scores of the default network.

Each peak of the scores of turns is followed; the current scan, seen from above and turned by it, is correlated with the
previous one over all shifts by the fast Fourier transform, and each peak there is a candidate.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lidarslam.core.geometry import FloatArray, make_transform, rotation_z
from lidarslam.odometry.images.bird_eye import MOST_CELLS, bird_eye
from lidarslam.odometry.images.projection import Floats

# Turns and shifts that are followed, and their least probability relative to the best one's.
_TURNS, _SHIFT_PEAKS = 2, 3
_LEAST_PROBABILITY = 0.02
# Scores this near a peak belong to it: feature columns, cells.
_NEAR_COLUMNS, _NEAR_CELLS = 6, 4
_NEVER = np.float32(-1e4)
# Rows and columns of a correlation of grids, which goes round, that belong to the shifts from -MOST_CELLS on.
_WITHIN_REACH = np.ix_(*2 * (np.arange(-MOST_CELLS, MOST_CELLS + 1),))

Graph = Callable[..., list[Floats]]
"""A part of a network on one scan or one pair: float32 arrays in, float32 arrays out."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A motion that is likely by a network's scores."""

    T_prev_curr: FloatArray  # (4, 4)
    covariance: FloatArray  # (6, 6) of a change of it from the left, rotation first
    log_probability: float  # natural logarithm; of all candidates of a pair together at most 0

    def is_motion(self) -> bool:
        """Whether all of it is finite."""
        variances = np.diag(self.covariance)
        return bool(np.isfinite(self.T_prev_curr).all() and np.isfinite(variances).all() and (variances > 0.0).all())


_NO_MOTION = Candidate(np.full((4, 4), np.nan), np.full((6, 6), np.nan), 0.0)


@dataclass(frozen=True, eq=False)
class Described:
    """The features of a scan, to compare the next one with."""

    columns: Floats  # (1, C, H', W') features of the range image
    spectrum: NDArray[np.complex64]  # (F, CELLS, CELLS / 2 + 1) of the features seen from above
    # angle by which the scan was turned for these, radians. It follows the sensor's turns, so that each scan has to be
    # seen from above only once.
    heading: float


class Search(Protocol):
    """Finds candidates of the motion from one scan to the next."""

    def describe(self, points: Floats, normals: Floats, heading: float = 0.0) -> Described:
        """The features of a scan (3, H, W), points and normals."""

    def compare(self, previous: Described, points: Floats, normals: Floats) -> tuple[tuple[Candidate, ...], Described]:
        """The candidates, the most probable first, of the motion of a scan (3, H, W), and its features."""


@dataclass(frozen=True, eq=False)
class CorrelationSearch:
    """The search with the parts of the network `correlation`; implements `Search`."""

    columns: Graph  # points and normals (1, 3, H, W) -> features (1, C, H', W')
    turns: Graph  # features (1, C, H', W') of the previous and the current scan -> scores (1, W')
    bird: Graph  # grid (1, CHANNELS, CELLS, CELLS) -> features (1, F, CELLS, CELLS)
    peaks: Graph  # scores (1, W') and (1, SHIFTS, SHIFTS) -> turn (1,), radians; shift (1, 2), metres; log sigma (1, 6)

    def describe(self, points: Floats, normals: Floats, heading: float = 0.0) -> Described:
        (columns,) = self.columns(points[None], normals[None])
        return Described(columns, self._spectrum(points, normals, heading), heading)

    def compare(self, previous: Described, points: Floats, normals: Floats) -> tuple[tuple[Candidate, ...], Described]:
        (columns,) = self.columns(points[None], normals[None])
        (turn_scores,) = self.turns(previous.columns, columns)
        found: list[tuple[float, Candidate, Described]] = []
        for turns in _peaks(turn_scores, _TURNS, _NEAR_COLUMNS):
            angle = float(turns[0].argmax()) * (2.0 * math.pi / turns.shape[1])
            heading = math.remainder(previous.heading + angle, 2.0 * math.pi)
            current = Described(columns, self._spectrum(points, normals, heading), heading)
            shift_scores = _shift_scores(previous.spectrum, current.spectrum)
            for shifts in _peaks(shift_scores, _SHIFT_PEAKS, _NEAR_CELLS):
                # Of both correlations together: a wrong turn has no high peak among the shifts.
                score = float(turns.max() + shifts.max())
                found.append((score, self._candidate(previous, turns, shifts), current))
        if not found:  # weights can be finite, and their scores not
            return (_NO_MOTION,), Described(columns, previous.spectrum, previous.heading)
        found.sort(key=lambda one: -one[0])
        scores = np.array([score for score, _, _ in found])
        log_probabilities = scores - np.logaddexp.reduce(scores)
        kept = tuple(
            replace(one, log_probability=float(log_probability))
            for (_, one, _), log_probability in zip(found, log_probabilities, strict=True)
            if log_probability >= log_probabilities[0] + math.log(_LEAST_PROBABILITY)
        )
        return kept, found[0][2]

    def _spectrum(self, points: Floats, normals: Floats, heading: float) -> NDArray[np.complex64]:
        (features,) = self.bird(bird_eye(points, normals, heading)[None])
        return np.asarray(fft.rfft2(features[0]), dtype=np.complex64)

    def _candidate(self, previous: Described, turns: Floats, shifts: Floats) -> Candidate:
        angle, shift, log_sigma = (values[0] for values in self.peaks(turns, shifts))
        # The shift is seen in the frame of the previous grid, which is turned by its heading.
        back = rotation_z(-previous.heading)
        T_prev_curr = make_transform(rotation_z(float(angle)), back @ [shift[0], shift[1], 0.0])
        axes = np.kron(np.eye(2), back)
        variances = np.exp(2.0 * log_sigma.astype(np.float64))
        return Candidate(T_prev_curr, axes @ np.diag(variances) @ axes.T, 0.0)


@dataclass(frozen=True, eq=False)
class WholePairs:
    """The search with a network without parts, whose one motion is the only candidate; implements `Search`."""

    network: Graph  # points and normals (1, 6, H, W) of two scans -> T_prev_curr (1, 4, 4), log sigma (1, 6)

    def describe(self, points: Floats, normals: Floats, heading: float = 0.0) -> Described:
        return Described(np.concatenate([points, normals])[None], np.zeros((0, 0, 0), dtype=np.complex64), heading)

    def compare(self, previous: Described, points: Floats, normals: Floats) -> tuple[tuple[Candidate, ...], Described]:
        current = self.describe(points, normals)
        T_prev_curr, log_sigma = self.network(previous.columns, current.columns)
        variances = np.exp(2.0 * log_sigma[0].astype(np.float64))
        return (Candidate(T_prev_curr[0].astype(np.float64), np.diag(variances), 0.0),), current


def _shift_scores(previous: NDArray[np.complex64], current: NDArray[np.complex64]) -> Floats:
    """(1, SHIFTS, SHIFTS) correlation of features with these spectra, with the current scan shifted along y and x."""
    scores = fft.irfft2((previous * current.conj()).sum(axis=0))
    return np.ascontiguousarray(scores[_WITHIN_REACH][None], dtype=np.float32)


def _peaks(scores: Floats, most: int, near: int) -> list[Floats]:
    """The scores (1, S) of turns or (1, S, S) of shifts, again and again without the surroundings of earlier peaks."""
    found: list[Floats] = []
    best = float(scores.max())
    left = scores
    while len(found) < most and float(left.max()) > best + math.log(_LEAST_PROBABILITY):
        found.append(left)
        left = left.copy()
        peak = np.unravel_index(int(left[0].argmax()), left[0].shape)
        if len(peak) == 1:
            left[0][np.arange(peak[0] - near, peak[0] + near + 1) % left.shape[1]] = _NEVER
        else:
            rows, columns = (slice(max(0, i - near), i + near + 1) for i in peak)
            left[0][rows, columns] = _NEVER
    return found
