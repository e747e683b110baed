"""Self-consistency of a run's poses along the direction of travel, from scan pairs.

Registration that slips along the direction of travel leaves every scan well aligned with the ground and the facades
along the road; only surfaces that face that direction show the slip. For pairs of scans some metres apart, each facing
surfel of the later scan votes for the shifts along the direction that place it on a surfel of the earlier one:
a Hough transform of the point-to-plane distance with one parameter. At correct poses the votes peak at zero, after a
slip at the slip. Votes are counted and limited by blocks on the ground, so that a passing vehicle, with consistent
votes from one or two blocks, does not outvote static structure.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray, inverse, transform_points
from lidarslam.core.state import TRANSFORM, Shape, Stateful
from lidarslam.mapping.surfels.symmetric import SYMMETRIC, write_eigenvalues, write_eigenvector

# Pixels of one degree.
ROWS, COLUMNS = 180, 360
# Neighbourhood of a pixel, in rows and columns to either side; rings are farther apart than points of a ring.
_NEAR_ROWS, _NEAR_COLUMNS = 2, 1
# Largest distance of a neighbour, as a share of the range.
_REACH = 0.1
# Least cosine between normals of one surface in two scans.
_SAME_NORMAL = 0.9
_MIN_RANGE_M = 1.0
_FEWEST_NEIGHBOURS = 5
# Largest ratio of the variances of thickness and width, least ratio of those of width and length, and the largest
# thickness that noise explains.
_THINNEST_SHARE, _LINE_SHARE = 0.02, 0.05
_NOISE_M, _NOISE_OF_RANGE = 0.02, 0.005
# Least cosine between normal and beam: a few points of one stroke of a laser, with their range noise, make a plane that
# contains the beams, and moves with the sensor.
_LEAST_COSINE = 0.1
# Surfels face along a direction within this cosine. Fewer have no evidence; more take time without any gain.
_FACING = 0.6
_FEWEST_FACING, _MOST_FACING = 10, 800
# Edge of a block on the ground, the width of a vehicle, and the largest number of votes of its surfels.
_BLOCK_M, _MOST_OF_BLOCK = 2.0, 3.0
# Width of a vote, distance between shifts, and the largest shift.
_GATE_M, BIN_M, _FARTHEST_M = 0.15, 0.1, 32.0
# A scan is kept after this many metres or scans, whichever comes first, and paired with the last two.
_EVERY_M, _EVERY_SCANS = 7.0, 10
_PARTNERS = 2
# After this many scans every second burst is kept, then every fourth, and so on.
_MANY, _BURST = 256, 8
# A scene is periodic where a shift has this share of its votes with itself; over shorter shifts any surface has.
_REPEATED_SHARE, _LEAST_PERIOD_M = 0.3, 1.0
# Shifts in bins whose votes are kept, for poses that are corrected later.
_NEAR = 20
# A closer pair has no direction of travel: x and y of the LiDAR are tested.
_LEAST_WAY_M = 0.2
# A pair contradicts its relative pose when the pose has less than this share of the peak's votes within the tolerance,
# and so many fewer; a peak of fewer votes may be chance, or a vehicle.
LEAST_VOTES, LARGEST_SHARE, _LEAST_FEWER = 8.0, 0.5, 7.0
_TOLERANCE_BINS = 1
# Least contradicting pairs of a stretch. A single one counts where it has so many votes and another confirms it, or, in
# runs of fewer tested pairs, where it has more or the pose has less than a share of them; slips leave next to none.
_LEAST_PAIRS, _FEW_PAIRS, _LEAST_VOTES_OF_ONE = 2, 4, 10.0
_MANY_VOTES_OF_ONE, _LARGEST_SHARE_OF_ONE = 14.0, 0.1


@dataclass(frozen=True, eq=False)
class Surfels:
    """Small planes of a scan, in its LiDAR frame: points (N, 3), normals (N, 3) towards the sensor, radii (N,)."""

    points: Annotated[FloatArray, Shape(None, 3)]
    normals: Annotated[FloatArray, Shape(None, 3)]
    radii: Annotated[FloatArray, Shape(None)]

    @classmethod
    def of(cls, points: FloatArray) -> "Surfels":
        """Surfels of motion-compensated points (N, 3), at most one for each degree of azimuth and elevation."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        image = _draw_indices(points)
        pixels = np.argwhere(image >= 0)
        means, normals, variances = np.empty((3, len(pixels), 3))
        counts = np.empty(len(pixels), dtype=np.int64)
        write_planes(points, image, pixels, means, normals, variances, counts)
        along, ranges = np.einsum("ij,ij->i", normals, means), np.linalg.norm(means, axis=1)
        normals[along > 0.0] *= -1.0
        noise_m = _NOISE_M + _NOISE_OF_RANGE * ranges
        flat = (variances[:, 0] < _THINNEST_SHARE * variances[:, 1]) & (variances[:, 0] < noise_m**2)
        flat &= np.abs(along) > _LEAST_COSINE * ranges
        flat &= (variances[:, 1] > _LINE_SHARE * variances[:, 2]) & (counts >= _FEWEST_NEIGHBOURS)
        return cls(means[flat], normals[flat], 2.0 * np.sqrt(variances[flat, 2]))

    def facing(self, direction: FloatArray) -> "Surfels":
        """The surfels that face along a direction (3,), either way."""
        chosen = np.abs(self.normals @ direction) > _FACING
        return Surfels(self.points[chosen], self.normals[chosen], self.radii[chosen])

    def moved(self, T: FloatArray) -> "Surfels":
        """The surfels in another frame, by a transform (4, 4)."""
        return Surfels(transform_points(T, self.points), self.normals @ T[:3, :3].T, self.radii)


def shift_profile(
    first: Surfels, second: Surfels, T_first_second: FloatArray, direction: FloatArray
) -> FloatArray | None:
    """Votes (S,) for shifts of the second scan along a unit direction (3,) of the first one's frame.

    Every 0.1 m around the relative pose (4, 4) under test, which is in the middle. None where too few surfels face
    along the direction.
    """
    held, moved = first.facing(direction), second.moved(T_first_second).facing(direction)
    if min(len(held.points), len(moved.points)) < _FEWEST_FACING:
        return None
    stride = -(-len(moved.points) // _MOST_FACING)
    points, normals = moved.points[::stride], moved.normals[::stride]
    cells, block = np.unique(np.floor(points[:, :2] / _BLOCK_M), axis=0, return_inverse=True)
    order = np.argsort(block.ravel(), kind="stable")
    votes = np.empty((len(cells), 2 * round(_FARTHEST_M / BIN_M) + 1), dtype=np.float32)
    points, normals = np.ascontiguousarray(points[order]), np.ascontiguousarray(normals[order])
    blocks = block.ravel()[order].astype(np.int64)
    vote(points, normals, blocks, held.points, held.normals, held.radii, direction, _GATE_M, BIN_M, votes)
    return np.asarray(np.minimum(votes, _MOST_OF_BLOCK).sum(axis=0), dtype=np.float64)


@compiled
def _draw_indices(points: FloatArray) -> NDArray[np.int64]:
    """(ROWS, COLUMNS) the index of the last of the points (N, 3) in every pixel, -1 where there is none."""
    image = np.full((ROWS, COLUMNS), -1, dtype=np.int64)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        across = math.sqrt(x * x + y * y)
        if across * across + z * z >= _MIN_RANGE_M**2:
            column = int((math.atan2(y, x) + math.pi) / (2.0 * math.pi) * COLUMNS) % COLUMNS
            row = int((math.atan2(z, across) + 0.5 * math.pi) / math.pi * ROWS)
            image[min(row, ROWS - 1), column] = n
    return image


@compiled
def write_planes(
    points: FloatArray, image: NDArray[np.int64], pixels: NDArray[np.int64], means: FloatArray, normals: FloatArray,
    variances: FloatArray, counts: NDArray[np.int64],
) -> None:  # fmt: skip
    """Write the planes of the points around pixels (M, 2) of an image.

    The mean (M, 3), the axis of least variance (M, 3), the variances (M, 3) along the principal axes, ascending, and
    the number (M,) of the points.
    """
    offset, mean, products, covariance = np.empty(3), np.empty(3), np.empty(6), np.empty(6)
    for m in range(len(pixels)):
        centre = points[image[pixels[m, 0], pixels[m, 1]]]
        reach2 = _REACH * _REACH * (centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
        count = 0
        mean[:] = 0.0
        products[:] = 0.0
        for row in range(max(pixels[m, 0] - _NEAR_ROWS, 0), min(pixels[m, 0] + _NEAR_ROWS + 1, ROWS)):
            for step in range(-_NEAR_COLUMNS, _NEAR_COLUMNS + 1):
                n = image[row, (pixels[m, 1] + step) % COLUMNS]
                if n < 0:
                    continue
                for i in range(3):
                    offset[i] = points[n, i] - centre[i]
                if offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2 > reach2:
                    continue
                count += 1
                for i in range(3):
                    mean[i] += offset[i]
                for entry in range(6):
                    i, j = SYMMETRIC[entry]
                    products[entry] += offset[i] * offset[j]
        for i in range(3):
            mean[i] /= count
            means[m, i] = centre[i] + mean[i]
        for entry in range(6):
            i, j = SYMMETRIC[entry]
            covariance[entry] = products[entry] / count - mean[i] * mean[j]
        write_eigenvalues(covariance, variances[m])
        write_eigenvector(covariance, variances[m, 0], normals[m])
        counts[m] = count


@compiled
def vote(
    points: FloatArray, normals: FloatArray, blocks: NDArray[np.int64], held_points: FloatArray,
    held_normals: FloatArray, held_radii: FloatArray, direction: FloatArray, gate_m: float, bin_m: float,
    votes: NDArray[np.float32],
) -> None:  # fmt: skip
    """Add up votes for the shifts of a scan along a direction that place its surfels on those of another.

    A surfel p is in the plane of a held surfel a with a similar normal n after the shift n.(a - p) / n.d, and votes for
    it if it is then within a's radius; the vote falls off to zero at a distance of `gate_m` from the plane. A surfel
    has at most one vote for each shift.

    The M surfels of the one scan are in the order of their blocks (M,); the K of the other are in the same frame, none
    of their normals at right angles to the direction (3,). Votes (B, S) are of each block, for shifts every `bin_m`,
    that of zero in the middle.
    """
    votes[:, :] = 0.0
    middle = votes.shape[1] // 2
    own = np.empty(votes.shape[1], dtype=np.float32)
    for m in range(len(points)):
        own[:] = 0.0
        for k in range(len(held_points)):
            if _dot(held_normals[k], normals[m]) < _SAME_NORMAL:
                continue
            along, gap, squared = _dot(held_normals[k], direction), 0.0, 0.0
            for i in range(3):
                gap += held_normals[k, i] * (held_points[k, i] - points[m, i])
            shift = gap / along
            if not abs(shift) < middle * bin_m:
                continue
            for i in range(3):
                squared += (points[m, i] + shift * direction[i] - held_points[k, i]) ** 2
            if squared <= held_radii[k] * held_radii[k]:
                _vote_once(shift, gate_m / abs(along), bin_m, own)
        for s in range(len(own)):
            votes[blocks[m], s] += own[s]


@compiled_part
def _vote_once(shift: float, half: float, bin_m: float, votes: NDArray[np.float32]) -> None:
    """Raise the votes (S,) around a shift to a triangle of half-width `half`."""
    middle = len(votes) // 2
    first = max(int(np.ceil((shift - half) / bin_m)) + middle, 0)
    last = min(int(np.floor((shift + half) / bin_m)) + middle, len(votes) - 1)
    for s in range(first, last + 1):
        weight = np.float32(1.0 - abs((s - middle) * bin_m - shift) / half)
        votes[s] = max(votes[s], weight)


@compiled_part
def _dot(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@dataclass(frozen=True, eq=False)
class _Kept:
    """A scan that later ones are paired with."""

    number: int
    T_world_lidar: Annotated[FloatArray, TRANSFORM]
    surfels: Surfels


@dataclass(frozen=True, eq=False)
class PairTest:
    """Votes of a pair of scans for shifts along a direction."""

    # first, second: numbers of the scans
    first: int
    second: int
    direction: Annotated[FloatArray, Shape(3)]  # unit vector in the first one's frame
    translation: Annotated[FloatArray, Shape(3)]  # of the second in the first one's frame, at the tested pose
    # shift_m, votes: of the shift with most votes
    shift_m: float
    votes: float
    near: Annotated[FloatArray, Shape(2 * _NEAR + 1)]  # votes for the shifts around zero

    def at(self, T_world_lidar: FloatArray) -> "Contradiction":
        """The test at the final poses (N, 4, 4) of all scans, whether they are contradicted or not."""
        T_first_second = inverse(T_world_lidar[self.first]) @ T_world_lidar[self.second]
        moved = float((T_first_second[:3, 3] - self.translation) @ self.direction)
        bins = round(moved / BIN_M) + np.arange(-_TOLERANCE_BINS, _TOLERANCE_BINS + 1)
        fitting = float(self.near[bins[np.abs(bins) <= _NEAR] + _NEAR].max(initial=0.0))
        left_m = self.shift_m - moved
        if abs(left_m) <= (_TOLERANCE_BINS + 0.5) * BIN_M:
            fitting = max(fitting, self.votes)
        return Contradiction(self.first, self.second, round(left_m, 3), self.votes, fitting, 1)


@dataclass(frozen=True)
class Contradiction:
    """A stretch of scans whose surfaces contradict its poses."""

    # first, last: kept scans at its ends
    first: int
    last: int
    shift_m: float  # shift of the later scans along the direction of travel that the clearest pair votes for
    # votes, votes_at_pose: for that shift, and for the poses of the run
    votes: float
    votes_at_pose: float
    pairs: int  # number of contradicting pairs


class ConsistencyCheck(Stateful):
    """Tests pairs of scans as they come; memory grows with the number of pairs, 0.4 kB each."""

    tests: list[PairTest]
    _kept: list[_Kept]
    # number, pose (4, 4) and points (N, 3) of the latest scan, unless it was kept
    _latest: tuple[int, Annotated[FloatArray, TRANSFORM], Annotated[FloatArray, Shape(None, 3)]] | None
    _since_due: int
    _due: int
    _T_due: Annotated[FloatArray, TRANSFORM] | None

    def __init__(self) -> None:
        self.tests, self._kept = [], []
        self._latest = None
        self._since_due, self._due, self._T_due = 0, 0, None

    def add(self, points: FloatArray, number: int, T_world_lidar: FloatArray) -> None:
        """Add the next scan of the map, compensated points (N, 3); some are kept and paired with the ones before."""
        self._since_due += 1
        self._latest = number, T_world_lidar, points
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
        number, T_world_lidar, points = latest
        new = _Kept(number, T_world_lidar, Surfels.of(points))
        for kept in self._kept:
            self.tests += _tests(kept, new)
        self._kept = [*self._kept, new][-_PARTNERS:]

    def _is_skipped(self) -> bool:
        """Whether this scan lies between bursts; the cost grows with the logarithm of a long run's length."""
        every = 1 << int(math.log2(max(1.0, (self._due - 1) / _MANY + 1.0)))
        return (self._due - 1) // _BURST % every != 0


def _tests(first: _Kept, second: _Kept) -> list[PairTest]:
    """A test for each direction with enough evidence."""
    T_first_second = inverse(first.T_world_lidar) @ second.T_world_lidar
    way = T_first_second[:3, 3]
    length_m = float(np.linalg.norm(way))
    tests = []
    for direction in [way / length_m] if length_m > _LEAST_WAY_M else [np.eye(3)[0], np.eye(3)[1]]:
        profile = shift_profile(first.surfels, second.surfels, T_first_second, direction)
        if profile is None or profile.max() < LEAST_VOTES:
            continue
        profile = _unambiguous(profile, shift_profile(first.surfels, first.surfels, np.eye(4), direction))
        if profile.max() >= LEAST_VOTES:
            middle, peak = len(profile) // 2, int(profile.argmax())
            shift_m, votes = (peak - middle) * BIN_M, float(profile[peak])
            near = profile[middle - _NEAR : middle + _NEAR + 1].copy()
            tests.append(PairTest(first.number, second.number, direction, way, shift_m, votes, near))
    return tests


def _unambiguous(profile: FloatArray, of_itself: FloatArray | None) -> FloatArray:
    """The votes (S,) for shifts below half the period of the scene, as another scan's votes on itself show it.

    Those are periodic where surfaces stand at even distances, as columns do.
    """
    if of_itself is None:
        return profile
    shifts = np.abs(np.arange(len(profile)) - len(profile) // 2)
    alike = (of_itself > _REPEATED_SHARE * of_itself[len(profile) // 2]) & (shifts * BIN_M > _LEAST_PERIOD_M)
    return np.where(2 * shifts < shifts[alike].min(initial=2 * len(profile)), profile, 0.0)


def find_contradictions(tests: Sequence[PairTest], T_world_lidar: FloatArray) -> tuple[Contradiction, ...]:
    """The stretches where scans clearly fit better at a shift along their path than at their final poses (N, 4, 4)."""
    known = [test.at(T_world_lidar) for test in tests if max(test.first, test.second) < len(T_world_lidar)]
    high = [one for one in known if one.votes >= LEAST_VOTES]
    bad = [one for one in high if one.votes_at_pose < min(LARGEST_SHARE * one.votes, one.votes - _LEAST_FEWER)]
    stretches: list[list[Contradiction]] = []
    for one in sorted(bad, key=lambda one: one.first):
        if stretches and one.first < max(before.last for before in stretches[-1]):
            stretches[-1].append(one)
        else:
            stretches.append([one])
    return tuple(_together(pairs) for pairs in stretches if len(pairs) >= _LEAST_PAIRS or _counts(pairs[0], known))


def _counts(pair: Contradiction, known: Sequence[Contradiction]) -> bool:
    """Whether a single pair counts: in a short run, a clear one; else where another one confirms it.

    That is a pair with the same first scan that peaks at the same shift, though not as clearly.
    """
    if pair.votes < _LEAST_VOTES_OF_ONE:
        return False
    is_clear = pair.votes > _MANY_VOTES_OF_ONE or pair.votes_at_pose < _LARGEST_SHARE_OF_ONE * pair.votes
    if len(known) < _FEW_PAIRS and is_clear:
        return True
    others = (other for other in known if other is not pair and other.first == pair.first)
    return any(abs(other.shift_m - pair.shift_m) < (_TOLERANCE_BINS + 0.5) * BIN_M for other in others)


def _together(pairs: list[Contradiction]) -> Contradiction:
    clearest = max(pairs, key=lambda one: one.votes - one.votes_at_pose)
    return replace(clearest, first=pairs[0].first, last=max(one.last for one in pairs), pairs=len(pairs))
