"""Self-consistency of a run's poses along the direction of travel, from scan pairs.

Registration that slips along the direction of travel leaves every scan well aligned with the ground and the facades
beside the road; only surfaces that face along the way show the slip. For pairs of scans some metres apart, each facing
surfel of the later scan votes for the shifts along the direction of travel that lay it on a surfel of the earlier one:
a Hough transform of the point-to-plane distance with one parameter. At correct poses the votes peak at zero, after a
slip at the slip. Votes are counted and limited by blocks on the ground, so that a passing vehicle, with consistent
votes from one or two blocks, does not outvote static structure.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import TRANSFORM, Shape, Stateful
from lidarslam.mapping.slides.scan_surfels import BIN_M, Surfels, shift_profile

# A scan is kept after so many metres or scans, whichever comes first, and paired with the last two.
_EVERY_M, _EVERY_SCANS = 7.0, 10
_PARTNERS = 2
# After so many scans every second burst is kept, then every fourth, and so on.
_MANY, _BURST = 256, 8
# A scene is periodic where a shift has this share of its votes with itself; over shorter shifts any surface has.
_REPEATED_SHARE, _LEAST_PERIOD_M = 0.3, 1.0
# Shifts in bins whose votes are kept, for poses that are corrected later.
_NEAR = 20
# A closer pair has no direction of travel: x and y of the LiDAR are tested.
_LEAST_WAY_M = 0.2
# A pair contradicts its relative pose when the pose has less than this share of the peak's votes within the tolerance;
# a peak of fewer votes may be chance, or a vehicle.
LEAST_VOTES, LARGEST_SHARE = 8.0, 0.5
_TOLERANCE_BINS = 1
# A stretch is contradicted by so many pairs, in runs of at least so many.
_LEAST_PAIRS, _FEW_PAIRS = 2, 4


@dataclass(frozen=True, eq=False)
class _Kept:
    """A scan that later ones are paired with."""

    number: int
    T_world_lidar: Annotated[FloatArray, TRANSFORM]
    surfels: Surfels


@dataclass(frozen=True, eq=False)
class _Candidate:
    """The latest scan."""

    number: int
    T_world_lidar: Annotated[FloatArray, TRANSFORM]
    points: Annotated[FloatArray, Shape(None, 3)]


@dataclass(frozen=True, eq=False)
class PairTests:
    """Tests of pairs of scans along a direction, a row each."""

    numbers: FloatArray  # (P, 2) of the scans
    directions: FloatArray  # (P, 3) unit vectors in the first one's frame
    translations: FloatArray  # (P, 3) of the second in the first one's frame, at the tested poses
    peaks: FloatArray  # (P, 2) the shift with most votes, metres, and its votes
    near: FloatArray  # (P, 41) votes for the shifts around zero

    @classmethod
    def of(cls, rows: FloatArray) -> "PairTests":
        """From rows (P, 51) of `_row`."""
        return cls(*np.split(rows, (2, 5, 8, 10), axis=1))

    def __len__(self) -> int:
        return len(self.numbers)

    def at(self, T_world_lidar: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Votes (P,) for the final poses (N, 4, 4) of all scans, and the distance (P,) of the peaks from them."""
        first, second = self.numbers.astype(np.intp).T
        relative = (inverse(T_world_lidar[first]) @ T_world_lidar[second])[:, :3, 3]
        moved = np.einsum("ij,ij->i", relative - self.translations, self.directions)
        bins = np.rint(moved / BIN_M).astype(np.intp)[:, None] + np.arange(-_TOLERANCE_BINS, _TOLERANCE_BINS + 1)
        votes = np.take_along_axis(self.near, np.clip(bins + _NEAR, 0, 2 * _NEAR), axis=1)
        fitting = np.where(np.abs(bins) <= _NEAR, votes, 0.0).max(axis=1)
        left = self.peaks[:, 0] - moved
        at_peak = np.abs(left) <= (_TOLERANCE_BINS + 0.5) * BIN_M
        return np.where(at_peak, np.maximum(fitting, self.peaks[:, 1]), fitting), left


@dataclass(frozen=True)
class Contradiction:
    """A stretch of scans whose surfaces contradict its poses."""

    # first, last: kept scans at its ends
    first: int
    last: int
    shift_m: float  # shift of the later scans along the way that the clearest pair votes for
    # votes, votes_at_pose: for that shift, and for the poses of the run
    votes: float
    votes_at_pose: float
    pairs: int  # number of contradicting pairs


class SlideCheck(Stateful):
    """Tests pairs of scans as they come; memory grows with the number of pairs, 0.4 kB each."""

    _kept: list[_Kept]
    _latest: _Candidate | None
    _since_due: int
    _due: int
    _T_due: Annotated[FloatArray, TRANSFORM] | None
    _rows: list[Annotated[FloatArray, Shape(11 + 2 * _NEAR)]]

    def __init__(self) -> None:
        self._kept = []
        self._latest = None  # unless it was kept
        self._since_due = 0
        self._due = 0
        self._T_due = None
        self._rows = []

    @property
    def numbers(self) -> tuple[int, ...]:
        """Of the scans that were kept last."""
        return tuple(one.number for one in (*self._kept, self._latest) if one is not None)

    def add(self, points: FloatArray, number: int, T_world_lidar: FloatArray) -> None:
        """Add the next scan of the map; some are kept and paired with the ones before.

        Args:
            points: (N, 3) in the LiDAR frame at the stamp, compensated.
            number: of the scan in its run.
            T_world_lidar: (4, 4), its pose.
        """
        self._since_due += 1
        self._latest = _Candidate(number, T_world_lidar, points)
        if self._T_due is not None and self._since_due < _EVERY_SCANS:
            way = T_world_lidar[:3, 3] - self._T_due[:3, 3]
            if float(np.linalg.norm(way)) < _EVERY_M:
                return
        self._since_due, self._T_due, self._due = 0, T_world_lidar, self._due + 1
        if self._is_skipped():
            self._kept, self._latest = [], None
        else:
            self.finish()

    def finish(self) -> None:
        """Keep the last scan as well, when there are no more."""
        latest, self._latest = self._latest, None
        if latest is None:
            return
        new = _Kept(latest.number, latest.T_world_lidar, Surfels.of(latest.points))
        for kept in self._kept:
            self._rows.extend(_tests(kept, new))
        self._kept = [*self._kept, new][-_PARTNERS:]

    def _is_skipped(self) -> bool:
        """Whether this scan lies between bursts; the cost grows with the logarithm of a long run's length."""
        every = 1 << int(math.log2(max(1.0, (self._due - 1) / _MANY + 1.0)))
        return (self._due - 1) // _BURST % every != 0

    @property
    def tests(self) -> PairTests:
        """All tests."""
        return PairTests.of(np.array(self._rows).reshape(-1, 11 + 2 * _NEAR))


def _tests(first: _Kept, second: _Kept) -> list[FloatArray]:
    """A row for each direction with enough evidence."""
    T_first_second = inverse(first.T_world_lidar) @ second.T_world_lidar
    way = T_first_second[:3, 3]
    length_m = float(np.linalg.norm(way))
    rows = []
    for direction in [way / length_m] if length_m > _LEAST_WAY_M else [np.eye(3)[0], np.eye(3)[1]]:
        profile = shift_profile(first.surfels, second.surfels, T_first_second, direction)
        if profile is None or profile.max() < LEAST_VOTES:
            continue
        profile = _unambiguous(profile, shift_profile(first.surfels, first.surfels, np.eye(4), direction))
        if profile.max() >= LEAST_VOTES:
            rows.append(_row(first.number, second.number, direction, way, profile))
    return rows


def _unambiguous(profile: FloatArray, of_itself: FloatArray | None) -> FloatArray:
    """The votes (S,) for shifts below half the period of the scene, and none for others.

    Args:
        profile: votes of a scan on another.
        of_itself: votes of the other on itself, periodic where surfaces stand at even distances, as columns do.
    """
    if of_itself is None:
        return profile
    shifts = np.abs(np.arange(len(profile)) - len(profile) // 2)
    alike = (of_itself > _REPEATED_SHARE * of_itself[len(profile) // 2]) & (shifts * BIN_M > _LEAST_PERIOD_M)
    return np.where(2 * shifts < shifts[alike].min(initial=2 * len(profile)), profile, 0.0)


def _row(first: int, second: int, direction: FloatArray, way: FloatArray, profile: FloatArray) -> FloatArray:
    middle, peak = len(profile) // 2, int(profile.argmax())
    near = profile[middle - _NEAR : middle + _NEAR + 1]
    return np.array([first, second, *direction, *way, (peak - middle) * BIN_M, profile[peak], *near])


def find_contradictions(tests: PairTests, T_world_lidar: FloatArray) -> tuple[Contradiction, ...]:
    """The stretches where scans clearly fit better at a shift along the way than at their final poses (N, 4, 4)."""
    known = (tests.numbers < len(T_world_lidar)).all(axis=1)
    tests = PairTests(*(values[known] for values in vars(tests).values()))
    if not len(tests):
        return ()
    fitting, left_m = tests.at(T_world_lidar)
    bad = np.flatnonzero((tests.peaks[:, 1] >= LEAST_VOTES) & (fitting < LARGEST_SHARE * tests.peaks[:, 1]))
    stretches: list[list[int]] = []
    for row in bad[np.argsort(tests.numbers[bad, 0], kind="stable")]:
        if stretches and tests.numbers[row, 0] < max(tests.numbers[stretches[-1], 1]):
            stretches[-1].append(int(row))
        else:
            stretches.append([int(row)])
    least = _LEAST_PAIRS if len(tests) >= _FEW_PAIRS else 1
    return tuple(_contradiction(tests, rows, fitting, left_m) for rows in stretches if len(rows) >= least)


def _contradiction(tests: PairTests, rows: list[int], fitting: FloatArray, left_m: FloatArray) -> Contradiction:
    clearest = rows[int(np.argmax(tests.peaks[rows, 1] - fitting[rows]))]
    return Contradiction(
        first=int(tests.numbers[rows, 0].min()),
        last=int(tests.numbers[rows, 1].max()),
        shift_m=round(float(left_m[clearest]), 3),
        votes=float(tests.peaks[clearest, 1]),
        votes_at_pose=float(fitting[clearest]),
        pairs=len(rows),
    )
