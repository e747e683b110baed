"""Whether a run's map contradicts itself: do scans fit one another better elsewhere along the way than at their poses?

Registration that slips along the direction of travel leaves every scan well aligned with the ground and with facades
beside the road. What tells a slip are surfaces that face along the way. Scans some metres apart are held against one
another in pairs: each such surface of the later scan votes for the shifts along the direction of travel that lay it on
one of the earlier scan (a Hough transform of the point-to-plane distance, with one parameter). At correct poses the
votes peak at zero; after a slip, at the slip. Votes are counted by blocks on the ground and limited in each, so that a
passing vehicle, whose votes agree with one another but come from one or two blocks, does not outvote what stands.
"""

import math
from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.state import Saved, State
from mapping.slides.kernels import COLUMNS, ROWS, draw_indices, vote, write_moments

# A scan is held after so many metres or scans, whichever comes first, against the last two that were.
_EVERY_M, _EVERY_SCANS = 7.0, 10
_AGAINST = 2
# In long runs every second burst of scans is held from here on, then every fourth, and so on.
_MANY, _BURST = 256, 8

_MIN_RANGE_M = 1.0
_FEWEST_NEIGHBOURS = 5
# A surfel is this much thinner than wide (ratios of variances), wider than a line, and no thicker than noise allows.
_THINNEST_SHARE, _LINE_SHARE = 0.02, 0.05
_NOISE_M, _NOISE_OF_RANGE = 0.02, 0.005

# Surfels face along the way within this cosine. Fewer say nothing; more take time and say no more.
_FACING = 0.6
_FEWEST_FACING, _MOST_FACING = 10, 800
# Edge of a block on the ground, the width of a vehicle, and how much its surfels count at most.
_BLOCK_M, _MOST_OF_BLOCK = 2.0, 3.0
_GATE_M, _BIN_M, _FARTHEST_M = 0.15, 0.1, 32.0
# A scene repeats itself where it has so large a share of its votes on itself; over shorter ways any surface does.
_REPEATED_SHARE, _LEAST_PERIOD_M = 0.3, 1.0
# Shifts that are remembered, for poses that are corrected later.
_NEAR = 20
# A pair that is closer has no direction of travel: x and y of the LiDAR are tried.
_LEAST_WAY_M = 0.2

# A peak of fewer votes may be chance or one that passes. A pair is contradicted when its pose has less than this share
# of the peak's votes within so many bins.
LEAST_VOTES, LARGEST_SHARE = 6.0, 0.5
_TOLERANCE_BINS = 1
# A stretch is contradicted by so many pairs, unless there are not as many in the run.
_LEAST_PAIRS, _FEW_PAIRS = 2, 4


@dataclass(frozen=True, eq=False)
class Surfels:
    """Small planes of a scan, in its LiDAR frame: points (N, 3), normals (N, 3) towards the sensor, radii (N,)."""

    points: FloatArray
    normals: FloatArray
    radii: FloatArray

    @classmethod
    def of(cls, points: FloatArray) -> "Surfels":
        """Of motion-compensated points (N, 3): at most one for each degree of azimuth and elevation."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        image = np.empty((ROWS, COLUMNS), dtype=np.int64)
        draw_indices(points, _MIN_RANGE_M, image)
        pixels = np.argwhere(image >= 0)
        means, covariances = np.empty((len(pixels), 3)), np.empty((len(pixels), 3, 3))
        counts = np.empty(len(pixels), dtype=np.int64)
        write_moments(points, image, pixels, means, covariances, counts)
        known = counts >= _FEWEST_NEIGHBOURS
        means, covariances = means[known], covariances[known]
        variances, axes = np.linalg.eigh(covariances)
        normals = axes[:, :, 0]
        normals[np.einsum("ij,ij->i", normals, means) > 0.0] *= -1.0
        noise_m = _NOISE_M + _NOISE_OF_RANGE * np.linalg.norm(means, axis=1)
        flat = (variances[:, 0] < _THINNEST_SHARE * variances[:, 1]) & (variances[:, 0] < noise_m**2)
        flat &= variances[:, 1] > _LINE_SHARE * variances[:, 2]
        return cls(means[flat], normals[flat], 2.0 * np.sqrt(variances[flat, 2]))

    @classmethod
    def restored(cls, saved: Saved) -> "Surfels":
        """What was saved."""
        points = saved.array("points", (None, 3))
        return cls(points, saved.array("normals", (len(points), 3)), saved.array("radii", (len(points),)))

    def facing(self, direction: FloatArray) -> "Surfels":
        """Those that face along a direction (3,), either way."""
        chosen = np.abs(self.normals @ direction) > _FACING
        return Surfels(self.points[chosen], self.normals[chosen], self.radii[chosen])

    def moved(self, T: FloatArray) -> "Surfels":
        """The same in another frame."""
        return Surfels(transform_points(T, self.points), self.normals @ T[:3, :3].T, self.radii)


def shift_profile(
    first: Surfels, second: Surfels, T_first_second: FloatArray, direction: FloatArray
) -> FloatArray | None:
    """Votes (S,) for shifts of the second scan along a direction, every 0.1 m; the shift of zero is in the middle.

    Args:
        first, second: of two scans, each in its frame.
        T_first_second: (4, 4), the relative pose that is tested.
        direction: (3,) unit vector in the first's frame.

    Returns:
        None where too few surfels face that way.
    """
    held, moved = first.facing(direction), second.moved(T_first_second).facing(direction)
    if min(len(held.points), len(moved.points)) < _FEWEST_FACING:
        return None
    stride = -(-len(moved.points) // _MOST_FACING)
    points, normals = moved.points[::stride], moved.normals[::stride]
    cells, block = np.unique(np.floor(points[:, :2] / _BLOCK_M), axis=0, return_inverse=True)
    order = np.argsort(block.ravel(), kind="stable")
    votes = np.empty((len(cells), 2 * round(_FARTHEST_M / _BIN_M) + 1), dtype=np.float32)
    points, normals = np.ascontiguousarray(points[order]), np.ascontiguousarray(normals[order])
    blocks = block.ravel()[order].astype(np.int64)
    vote(points, normals, blocks, held.points, held.normals, held.radii, direction, _GATE_M, _BIN_M, votes)
    return np.asarray(np.minimum(votes, _MOST_OF_BLOCK).sum(axis=0), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Held:
    """A scan that later ones are held against."""

    number: int
    T_world_lidar: FloatArray
    surfels: Surfels

    def state(self) -> State:
        return {"number": self.number, "T_world_lidar": self.T_world_lidar, "surfels": dict(vars(self.surfels))}

    @classmethod
    def restored(cls, saved: Saved) -> "_Held":
        T = saved.array("T_world_lidar", (4, 4))
        return cls(saved.integer("number"), T, Surfels.restored(saved.part("surfels")))


@dataclass(frozen=True, eq=False)
class _Offered:
    """A scan that may be held."""

    number: int
    T_world_lidar: FloatArray
    points: FloatArray

    @classmethod
    def restored(cls, saved: Saved) -> "_Offered":
        return cls(saved.integer("number"), saved.array("T_world_lidar", (4, 4)), saved.array("points", (None, 3)))


@dataclass(frozen=True, eq=False)
class PairTests:
    """Pairs of scans that could be tested along a direction, a row each.

    Attributes:
        numbers: (P, 2) the scans.
        directions: (P, 3) unit vectors in the first one's frame.
        translations: (P, 3) of the second in the first one's frame, at the poses that were tested.
        peaks: (P, 2) the shift with most votes, metres, and how many.
        near: (P, 41) votes for the shifts around zero.
    """

    numbers: FloatArray
    directions: FloatArray
    translations: FloatArray
    peaks: FloatArray
    near: FloatArray

    @classmethod
    def of(cls, rows: FloatArray) -> "PairTests":
        """Of rows (P, 51) as `_row` writes them."""
        return cls(*np.split(rows, (2, 5, 8, 10), axis=1))

    def __len__(self) -> int:
        return len(self.numbers)

    def at(self, T_world_lidar: FloatArray) -> tuple[FloatArray, FloatArray]:
        """At final poses (N, 4, 4) of all scans: votes (P,) for these poses, and how far (P,) the peak is from them."""
        first, second = self.numbers.astype(np.intp).T
        relative = (inverse(T_world_lidar[first]) @ T_world_lidar[second])[:, :3, 3]
        moved = np.einsum("ij,ij->i", relative - self.translations, self.directions)
        bins = np.rint(moved / _BIN_M).astype(np.intp)[:, None] + np.arange(-_TOLERANCE_BINS, _TOLERANCE_BINS + 1)
        votes = np.take_along_axis(self.near, np.clip(bins + _NEAR, 0, 2 * _NEAR), axis=1)
        fitting = np.where(np.abs(bins) <= _NEAR, votes, 0.0).max(axis=1)
        left = self.peaks[:, 0] - moved
        at_peak = np.abs(left) <= (_TOLERANCE_BINS + 0.5) * _BIN_M
        return np.where(at_peak, np.maximum(fitting, self.peaks[:, 1]), fitting), left


@dataclass(frozen=True)
class Contradiction:
    """A stretch of scans whose poses their own surfaces contradict.

    Attributes:
        first, last: scans that were held, between which it lies.
        shift_m: how much farther along the way the later scans fit best, negative for less far; of the clearest pair.
        votes, votes_at_pose: for that, and for the poses of the run.
        pairs: how many pairs of scans contradict.
    """

    first: int
    last: int
    shift_m: float
    votes: float
    votes_at_pose: float
    pairs: int


class SlideCheck:
    """Holds scans against the ones before as they come; memory follows the number of pairs, 0.4 kB each."""

    def __init__(self) -> None:
        self._held: list[_Held] = []
        self._latest: _Offered | None = None  # the last that was offered, when it was not held
        self._offered = 0  # since the last that was due
        self._due = 0
        self._T_due: FloatArray | None = None
        self._rows: list[FloatArray] = []

    def state(self) -> State:
        """All of it."""
        return {
            "held": [held.state() for held in self._held],
            "latest": None if self._latest is None else dict(vars(self._latest)),
            "offered": self._offered,
            "due": self._due,
            "T_due": self._T_due,
            "rows": np.array(self._rows).reshape(-1, 11 + 2 * _NEAR),
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self._held = [_Held.restored(part) for part in saved.parts("held")]
        self._latest = saved.optional("latest", _Offered.restored)
        self._offered, self._due = saved.integer("offered"), saved.integer("due")
        self._T_due = saved.optional_array("T_due", (4, 4))
        self._rows = list(saved.array("rows", (None, 11 + 2 * _NEAR)))

    def add(self, points: FloatArray, number: int, T_world_lidar: FloatArray) -> None:
        """Offer the next scan that belongs in the map; some are held, and held against those before.

        Args:
            points: (N, 3) in the LiDAR frame at the scan's stamp, compensated.
            number: of the scan in its run.
            T_world_lidar: (4, 4), its pose.
        """
        self._offered += 1
        self._latest = _Offered(number, T_world_lidar, points)
        if self._T_due is not None and self._offered < _EVERY_SCANS:
            way = T_world_lidar[:3, 3] - self._T_due[:3, 3]
            if float(np.linalg.norm(way)) < _EVERY_M:
                return
        self._offered, self._T_due, self._due = 0, T_world_lidar, self._due + 1
        if self._is_skipped():
            self._held, self._latest = [], None
        else:
            self.finish()

    def finish(self) -> None:
        """Hold the last scan, too, when there are no more."""
        latest, self._latest = self._latest, None
        if latest is None:
            return
        new = _Held(latest.number, latest.T_world_lidar, Surfels.of(latest.points))
        for held in self._held:
            self._rows.extend(_tests(held, new))
        self._held = [*self._held, new][-_AGAINST:]

    def _is_skipped(self) -> bool:
        """Whether this scan lies between bursts: the cost grows with the logarithm of a long run's length."""
        every = 1 << int(math.log2(max(1.0, (self._due - 1) / _MANY + 1.0)))
        return (self._due - 1) // _BURST % every != 0

    @property
    def tests(self) -> PairTests:
        """Everything that was tested."""
        return PairTests.of(np.array(self._rows).reshape(-1, 11 + 2 * _NEAR))


def _tests(first: _Held, second: _Held) -> list[FloatArray]:
    """A row for each direction along which the pair could be tested."""
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
    """The votes (S,) for shifts of less than half the distance at which the scene repeats itself, and none for others.

    Args:
        profile: of a scan on another.
        of_itself: of the other on itself, which repeats where surfaces stand at even distances, as columns do.
    """
    if of_itself is None:
        return profile
    shifts = np.abs(np.arange(len(profile)) - len(profile) // 2)
    alike = (of_itself > _REPEATED_SHARE * of_itself[len(profile) // 2]) & (shifts * _BIN_M > _LEAST_PERIOD_M)
    return np.where(2 * shifts < shifts[alike].min(initial=2 * len(profile)), profile, 0.0)


def _row(first: int, second: int, direction: FloatArray, way: FloatArray, profile: FloatArray) -> FloatArray:
    middle, peak = len(profile) // 2, int(profile.argmax())
    near = profile[middle - _NEAR : middle + _NEAR + 1]
    return np.array([first, second, *direction, *way, (peak - middle) * _BIN_M, profile[peak], *near])


def find_contradictions(tests: PairTests, T_world_lidar: FloatArray) -> tuple[Contradiction, ...]:
    """The stretches where scans clearly fit better elsewhere along the way than at their final poses (N, 4, 4)."""
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
